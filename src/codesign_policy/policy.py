"""What every policy offers, scripted or learned, and how one is loaded by its name."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from codesign_policy.scripted import GraspPlan, ScriptedGrasp
from codesign_policy.task import ControlAction, Observation


@dataclass(frozen=True)
class Surroundings:
    """What a policy may know besides its observations.

    Attributes:
        table_height: z of the table in link_base [m].
        tip_depth: how far the finger tips reach beyond the tool centre point [m].
        min_width: smallest gap of the fingers in use [m].
    """

    table_height: float
    tip_depth: float
    min_width: float


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


def _scripted(around: Surroundings, plan: GraspPlan) -> Policy:
    return ScriptedGrasp(
        plan, around.table_height, tip_depth=around.tip_depth, min_width=around.min_width
    )


_POLICIES: dict[str, Callable[[Surroundings, GraspPlan], Policy]] = {"scripted": _scripted}


def policy_names() -> list[str]:
    """Names that `load_policy` knows."""
    return sorted(_POLICIES)


def load_policy(name: str, around: Surroundings, plan: GraspPlan | None = None) -> Policy:
    """Makes the policy of that name.

    Args:
        name: one of `policy_names()`.
        around: table and fingers.
        plan: settings of the scripted grasp.

    Raises:
        ValueError: unknown name.
    """
    if name not in _POLICIES:
        raise ValueError(f"policy {name!r}: unknown; there are {', '.join(policy_names())}")
    return _POLICIES[name](around, plan or GraspPlan())
