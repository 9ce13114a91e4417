"""What every policy offers, scripted or learned, and how one is loaded by its name."""

from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from codesign_design.finger_pair import FingerPair
from codesign_policy.learned import LearnedGrasp
from codesign_policy.policy_file import TrainedPair, load_pair
from codesign_policy.scripted import GraspPlan, ScriptedGrasp
from codesign_policy.shipped import POLICY, checkpoint_names, checkpoint_path
from codesign_policy.task import ControlAction, Observation

SCRIPTED = "scripted"


@dataclass(frozen=True)
class Surroundings:
    """What a policy may know besides its observations.

    Attributes:
        table_height: z of the table in link_base [m].
        fingers: the pair in use.
    """

    table_height: float
    fingers: FingerPair


class Policy(Protocol):
    """A controller of the control stage, called once every `task.POLICY_PERIOD`."""

    def reset(self) -> None:
        """Forgets the last trial."""

    def act(self, observation: Observation) -> ControlAction:
        """The action that answers this observation."""

    @property
    def phase(self) -> str:
        """The policy's word for what it does now."""

    @property
    def done(self) -> bool:
        """True once it has nothing more to do; it may still be asked to act."""


def policy_names() -> list[str]:
    """Names that `load_policy` knows; it also takes the path of a checkpoint."""
    return [SCRIPTED, *checkpoint_names()]


def policy_label(name: str) -> str:
    """A word for people, and for files: the name itself, or the last of a path that tells."""
    path = Path(name)
    return path.parent.name if path.name == POLICY else path.stem


def trained_pair(name: str) -> TrainedPair | None:
    """The pair of a checkpoint's name or path; None for the scripted grasp, which has none.

    Raises:
        ValueError: unknown name, or a file that cannot be used.
    """
    if name == SCRIPTED:
        return None
    if name not in policy_names() and not Path(name).exists():
        raise ValueError(
            f"policy {name!r}: unknown; there are {', '.join(policy_names())}; or give the path of "
            "a checkpoint"
        )
    return load_pair(checkpoint_path(name))


def load_policy(name: str, around: Surroundings, plan: GraspPlan | None = None) -> Policy:
    """Makes the policy of that name.

    Args:
        name: one of `policy_names()`, or the path of a checkpoint.
        around: table and fingers.
        plan: settings of the scripted grasp.

    Raises:
        ValueError: unknown name, a file that cannot be used, or fingers that it is not for.
    """
    pair = trained_pair(name)
    if pair is not None:
        return LearnedGrasp(pair, around.fingers)
    fingers = around.fingers
    return ScriptedGrasp(
        plan or GraspPlan(),
        around.table_height,
        tip_depth=fingers.tip_depth,
        min_width=fingers.min_width,
    )
