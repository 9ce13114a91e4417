"""A scripted expert: approach, close to a width, lift, hold."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from codesign_policy.task import POLICY_PERIOD, ControlAction, Observation

CORRECTION_GAIN = 0.2  # of the error, per policy period
DEAD_BAND = 2e-5  # m
LAG_STEPS = 5  # policy periods after a move until arm and gripper have arrived


@dataclass(frozen=True)
class GraspPlan:
    """Settings of the scripted grasp. Lengths in metres, times in seconds.

    Attributes:
        width: gap to close to. 27.3 mm holds a 30 mm block of 8-10 kPa at friction 0.5 with the
            stock fingers with about a quarter more normal force than the slip threshold.
        open_width: gap during the approach.
        hover: distance of the finger tips above the object's centre before the descent.
        clearance: distance of the finger tips above the table during the grasp.
        lift: how far to lift.
        speed: peak speed of the tool centre point [m/s].
        lift_time: of the minimum-jerk lift.
        close_speed: peak closing speed of the gap [m/s].
        settle_time: between closing and lifting; what is still missing of place and gap is made
            up for then.
        hold_time: after lifting, before it is done.
    """

    width: float = 0.0273
    open_width: float = 0.046
    hover: float = 0.035
    clearance: float = 0.0015
    lift: float = 0.100
    speed: float = 0.13
    lift_time: float = 1.6
    close_speed: float = 0.03
    settle_time: float = 0.8
    hold_time: float = 1.5

    def slowed(self, pace: float) -> "GraspPlan":
        """The same grasp at a share of its speed, 0 to 1.

        Raises:
            ValueError: `pace` is not in (0, 1].
        """
        if not 0.0 < pace <= 1.0:
            raise ValueError(f"pace {pace}: must be above 0 and at most 1")
        return replace(
            self,
            speed=self.speed * pace,
            close_speed=self.close_speed * pace,
            lift_time=self.lift_time / pace,
        )


@dataclass(frozen=True)
class _Segment:
    """A minimum-jerk move of tool centre point and gap to a target."""

    phase: str
    position: NDArray[np.float64]
    width: float
    duration: float


class ScriptedGrasp:
    """Follows a chain of minimum-jerk segments, planned from the first observation.

    Actions are integrated on the commanded pose, so while it moves the script sends the
    differences of its own reference and does not chase the measured pose, which lags. Where it
    stands it corrects what the measurement shows: a lost action must not end in a loose grip.
    """

    def __init__(
        self, plan: GraspPlan, table_height: float, *, tip_depth: float, min_width: float
    ) -> None:
        """Args: plan; table height in link_base [m]; reach of the tips beyond the TCP [m];
        smallest gap of the fingers [m].

        Raises:
            ValueError: the plan closes further than the fingers allow.
        """
        if plan.width < min_width:
            raise ValueError(
                f"closing width {plan.width} m: the fingers allow {min_width} m and more"
            )
        self._plan = plan
        self._table_height = table_height
        self._tip_depth = tip_depth
        self.reset()

    def reset(self) -> None:
        """Forgets the last trial; the next observation makes a new plan."""
        self._segments: list[_Segment] = []
        self._steps = 0
        self._start_position = np.zeros(3)
        self._start_width = 0.0
        self._reference = np.zeros(4)
        self._phase = "idle"
        self._done = False

    @property
    def phase(self) -> str:
        """Name of the segment in progress."""
        return self._phase

    @property
    def done(self) -> bool:
        """True after the hold."""
        return self._done

    def act(self, observation: Observation) -> ControlAction:
        """The next difference of the reference, within the task's limits."""
        if self._phase == "idle":
            self._begin(observation)
        target = self._next_reference()
        step = target - self._reference
        if self._stands and self._steps > LAG_STEPS:
            step = step + self._correction(target, observation)
        action = ControlAction(step[:3], np.zeros(3), float(step[3])).clipped()
        # What was clipped stays to be done: the reference advances by what was really sent.
        self._reference = target - (step - [*action.translation, action.width])
        return action

    @property
    def _stands(self) -> bool:
        return self._phase in ("settle", "hold")

    def _correction(
        self, target: NDArray[np.float64], observation: Observation
    ) -> NDArray[np.float64]:
        """A part of what is missing, (4,); the arm's lag of about 0.1 s forbids more at a time."""
        missing = target - np.append(observation.tcp_position, observation.width)
        return np.where(np.abs(missing) > DEAD_BAND, CORRECTION_GAIN * missing, 0.0)

    def _begin(self, observation: Observation) -> None:
        self._start_position = observation.tcp_position.astype(np.float64)
        self._start_width = observation.width
        self._reference = np.append(self._start_position, self._start_width)
        self._segments = self._make_segments(observation)
        self._phase = self._segments[0].phase

    def _make_segments(self, observation: Observation) -> list[_Segment]:
        plan, centre = self._plan, observation.object_position
        over = np.array([centre[0], centre[1], centre[2] + plan.hover + self._tip_depth])
        down = np.array(
            [centre[0], centre[1], self._table_height + plan.clearance + self._tip_depth]
        )
        up = down + np.array([0.0, 0.0, plan.lift])
        opened = plan.open_width
        approach_time = max(
            _duration(float(np.linalg.norm(over - observation.tcp_position)), plan.speed),
            _duration(abs(opened - observation.width), 2.0 * plan.close_speed),
        )
        return [
            _Segment("approach", over, opened, approach_time),
            _Segment("descend", down, opened, _duration(over[2] - down[2], plan.speed)),
            _Segment("close", down, plan.width, _duration(opened - plan.width, plan.close_speed)),
            _Segment("settle", down, plan.width, plan.settle_time),
            _Segment("lift", up, plan.width, plan.lift_time),
            _Segment("hold", up, plan.width, plan.hold_time),
        ]

    def _next_reference(self) -> NDArray[np.float64]:
        """Where the reference should be one period from now, (4,): position and gap."""
        if self._done:
            return np.append(self._start_position, self._start_width)
        segment = self._segments[0]
        self._phase = segment.phase
        self._steps += 1
        steps = max(1, int(np.ceil(segment.duration / POLICY_PERIOD)))
        s = _minimum_jerk(self._steps / steps)
        start = np.append(self._start_position, self._start_width)
        end = np.append(segment.position, segment.width)
        if self._steps >= steps:
            self._finish_segment(segment)
        return start + s * (end - start)

    def _finish_segment(self, segment: _Segment) -> None:
        self._start_position, self._start_width = segment.position, segment.width
        self._steps = 0
        self._segments.pop(0)
        self._done = not self._segments


def _minimum_jerk(s: float) -> float:
    """Progress 0..1 with zero velocity and acceleration at both ends (Flash and Hogan 1985)."""
    return s**3 * (10.0 - 15.0 * s + 6.0 * s**2)


def _duration(distance: float, peak_speed: float) -> float:
    """Time of a minimum-jerk move with that peak speed: its peak is 1.875 times its mean."""
    return 1.875 * distance / peak_speed
