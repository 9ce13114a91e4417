"""The learner's settings: as published, and one for two cores."""

import math
from dataclasses import dataclass


@dataclass(frozen=True)
class Preset:
    """Settings of the learner. Times are counted in updates of the critics.

    Attributes:
        name: what it is called.
        critics: members of the ensemble.
        critic_subset: how many of the target critics, drawn anew, the target's minimum is over.
        encoding: whether networks see observations with what a millimetre changes (`task.encoded`).
        design_scale: by which networks see d enlarged, from the start design on: designs that are
            tried differ by hundredths.
        hidden: widths of the hidden layers, of critics and control actor.
        learning_rate: of Adam, everywhere.
        discount: per policy period of the control stage; none across the design boundary.
        target_rate: of the target critics towards the critics, per update.
        batch_size: rows per update, half demonstrations.
        design_rows: how many of them are of the design stage.
        updates_per_transition: update-to-data ratio.
        actor_period: updates of the critics per update of actors and temperatures.
        backup_entropy: whether the critics' target holds the entropy of what follows.
        start_transitions: experience to gather before the first update.
        control_temperature: weight of the control actor's entropy at the start.
        control_entropy: which the temperature aims at [nats].
        design_temperature: weight of the design actor's entropy; at the start, or fixed.
        design_entropy_per_parameter: which its temperature aims at, times D [nats]; None: fixed.
        design_temperature_range: bounds of an automatic design temperature.
        design_std: spread of the design actor at the start, before the tanh.
        design_std_range: its bounds.
        actor_average: rate at which the averaged actor, the one that is served, follows the control
            actor, per update of that; 1: they are the same.
        cloning: steps of regression to demonstrated actions that the control actor starts with.
        actor_rest: updates of the critics after that, before the actor follows them: critics that
            know little would lead it astray.
        imitation: weight of staying close to the clone's actions, in units of the values' size.
        imitation_half_life: updates after which that is half as much: critics learn.
        mean_rounds: whether every second round is played without exploration; it is these by which
            a search judges designs.
    """

    name: str
    critics: int
    critic_subset: int
    encoding: bool
    design_scale: float
    hidden: tuple[int, ...]
    learning_rate: float
    discount: float
    target_rate: float
    batch_size: int
    design_rows: int
    updates_per_transition: float
    actor_period: int
    backup_entropy: bool
    start_transitions: int
    control_temperature: float
    control_entropy: float
    design_temperature: float
    design_entropy_per_parameter: float | None
    design_temperature_range: tuple[float, float]
    design_std: float
    design_std_range: tuple[float, float]
    actor_average: float
    cloning: int
    actor_rest: int
    imitation: float
    imitation_half_life: float
    mean_rounds: bool


# RLPD as published: Ball et al. 2023 and its code, github.com/ikostrikov/rlpd. The entropy
# target -|A|/2 is split by stage: -3.5 for 7 control numbers, -0.5 per design parameter (-10.5 for
# 21). Design rows per batch and the bound of the design temperature are ours: unbounded, it ran
# away in trials.
PUBLISHED = Preset(
    name="published",
    critics=10,
    critic_subset=2,
    encoding=False,
    design_scale=1.0,
    hidden=(256, 256),
    learning_rate=3e-4,
    discount=0.99,
    target_rate=0.005,
    batch_size=256,
    design_rows=32,
    updates_per_transition=20.0,
    actor_period=20,
    backup_entropy=True,
    start_transitions=5000,
    control_temperature=1.0,
    control_entropy=-3.5,
    design_temperature=1.0,
    design_entropy_per_parameter=-0.5,
    design_temperature_range=(1e-4, 1.0),
    design_std=0.15,
    design_std_range=(1e-4, 0.5),
    actor_average=1.0,
    cloning=0,
    actor_rest=0,
    imitation=0.0,
    imitation_half_life=math.inf,
    mean_rounds=False,
)

# For two cores, where the simulator is far faster than the learner: few small critics, and a
# quarter of an update per transition. Sizes and rates are those that solved the task in trials on a
# prototype, where a design spread of 0.05 kept grasps alive and 0.12 did not; two critics as in
# HIL-SERL (Luo et al. 2024). The discount is that prototype's 0.97 at 10 Hz for our 20 Hz. The rest
# is ours: the clone, what it is held by, the averaged actor, and less entropy, as noise adds up in
# commanded differences and a clone has not much to find out.
FAST = Preset(
    name="fast",
    critics=2,
    critic_subset=2,
    encoding=True,
    design_scale=10.0,
    hidden=(128, 128),
    learning_rate=5e-4,
    discount=0.985,
    target_rate=0.01,
    batch_size=256,
    design_rows=32,
    updates_per_transition=0.25,
    actor_period=2,
    backup_entropy=False,
    start_transitions=1000,
    control_temperature=0.01,
    control_entropy=-8.0,
    design_temperature=0.01,
    design_entropy_per_parameter=None,
    design_temperature_range=(0.01, 0.01),
    design_std=0.05,
    design_std_range=(0.02, 0.1),
    actor_average=0.002,
    cloning=3000,
    actor_rest=4000,
    imitation=3.0,
    imitation_half_life=5000.0,
    mean_rounds=True,
)

PRESETS = {preset.name: preset for preset in (PUBLISHED, FAST)}
