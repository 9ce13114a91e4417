"""What every policy offers, scripted or learned, and how one is loaded by its name."""

import hashlib
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Protocol

from codesign_design.finger_pair import FingerPair
from codesign_policy.learned import Fingers, LearnedGrasp
from codesign_policy.policy_file import TrainedPair, load_pair, pair_bytes, read_pair
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
    return None if name == SCRIPTED else load_pair(_pair_path(name))


def _pair_path(name: str) -> Path:
    if name not in policy_names() and not Path(name).exists():
        raise ValueError(
            f"policy {name!r}: unknown; there are {', '.join(policy_names())}; or give the path of "
            "a checkpoint"
        )
    return checkpoint_path(name)


@dataclass(frozen=True)
class PolicySetup:
    """All that a policy is made of: kept with a recording, it gives the same policy again.

    Attributes:
        policy: the name that was asked for, or a path.
        file: what the trained pair's file held; empty for the scripted grasp.
        settings: arguments of `ScriptedGrasp` and of its plan, SI units; empty for a trained pair.
    """

    policy: str
    file: bytes = b""
    settings: Mapping[str, float] = field(default_factory=dict)

    @classmethod
    def of(cls, name: str, around: Surroundings, plan: GraspPlan | None = None) -> "PolicySetup":
        """What `load_policy` makes the policy of; arguments and errors as there."""
        if name != SCRIPTED:
            return cls(name, file=pair_bytes(_pair_path(name)))
        settings = asdict(plan or GraspPlan()) | {
            "table_height": around.table_height,
            "tip_depth": around.fingers.tip_depth,
            "min_width": around.fingers.min_width,
        }
        return cls(name, settings={key: float(value) for key, value in settings.items()})

    @property
    def file_hash(self) -> str:
        """SHA-256 of the trained pair's file; empty for the scripted grasp."""
        return hashlib.sha256(self.file).hexdigest() if self.file else ""

    def build(self, fingers: Fingers) -> Policy:
        """A new policy for the fingers in use.

        Raises:
            ValueError: a file that cannot be used, fingers that it is not for, or settings that
                the scripted grasp does not have.
        """
        if self.file:
            return LearnedGrasp(read_pair(self.file, Path(self.policy)), fingers)
        given = dict(self.settings)
        try:
            around = {key: given.pop(key) for key in ("table_height", "tip_depth", "min_width")}
            return ScriptedGrasp(GraspPlan(**given), **around)
        except (KeyError, TypeError) as error:
            raise ValueError(
                f"policy {self.policy!r}: settings {sorted(self.settings)} are not those of this "
                f"program's scripted grasp ({error})"
            ) from error


def load_policy(name: str, around: Surroundings, plan: GraspPlan | None = None) -> Policy:
    """Makes the policy of that name.

    Args:
        name: one of `policy_names()`, or the path of a checkpoint.
        around: table and fingers.
        plan: settings of the scripted grasp.

    Raises:
        ValueError: unknown name, a file that cannot be used, or fingers that it is not for.
    """
    return PolicySetup.of(name, around, plan).build(around.fingers)
