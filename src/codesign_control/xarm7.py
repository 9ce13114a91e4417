"""Kinematics of the UFACTORY xArm7 with the xArm gripper."""

from __future__ import annotations

from importlib.resources import files

import numpy as np
import pinocchio as pin

from codesign_control.pose import Pose, difference, finite_vector

# TCP over the table, pointing straight down, at (0.45, 0, 0.25) m in link_base. The joints with
# one-sided ranges (J2, J4, J6) stay more than 0.7 rad from their limits.
HOME = np.array([0.0, -0.0909228, 0.0, 1.1301161, 0.0, 1.2210390, 0.0])

IK_RESTARTS = 40
IK_ITERATIONS = 120
IK_STEP = 0.2  # rad, largest change of a joint in one iteration


class IkError(ValueError):
    """No joint vector inside the limits reaches the pose; the message names the nearest miss."""


class Xarm7:
    """Forward and inverse kinematics of `link_eef` (flange) and `link_tcp` (0.172 m further).

    Joint vectors are (7,) rad, joint1..joint7. Source of every number: the head of `xarm7.urdf`.
    One object holds scratch memory and serves one thread.
    """

    def __init__(self) -> None:
        self._model = pin.buildModelFromXML(urdf())
        self._data = self._model.createData()
        self._flange = self._model.getFrameId("link_eef")
        self._tcp = self._model.getFrameId("link_tcp")
        self.names: list[str] = list(self._model.names)[1:]
        self.lower: np.ndarray = self._model.lowerPositionLimit.copy()  # rad
        self.upper: np.ndarray = self._model.upperPositionLimit.copy()  # rad
        self.velocity: np.ndarray = self._model.velocityLimit.copy()  # rad/s
        self.effort: np.ndarray = self._model.effortLimit.copy()  # N m
        self.home: np.ndarray = HOME.copy()  # rad

    def fk_flange(self, q: np.ndarray) -> Pose:
        """Pose of `link_eef` at joint vector `q`."""
        return Pose.from_se3(self._placement(q, self._flange))

    def fk_tcp(self, q: np.ndarray) -> Pose:
        """Pose of `link_tcp` at joint vector `q`."""
        return Pose.from_se3(self.tcp_placement(q))

    def tcp_placement(self, q: np.ndarray) -> pin.SE3:
        """As `fk_tcp`, as a Pinocchio placement (cheaper)."""
        return self._placement(q, self._tcp)

    def jacobian_tcp(self, q: np.ndarray) -> np.ndarray:
        """(6, 7) Jacobian of `link_tcp`: linear [m/s] over angular [rad/s], in base axes."""
        # computeFrameJacobian would leave the joint placements (oMi) of the last call in place.
        pin.computeJointJacobians(self._model, self._data, np.asarray(q, dtype=float))
        return pin.getFrameJacobian(
            self._model, self._data, self._tcp, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
        )

    def within_limits(self, q: np.ndarray, margin: float = 0.0) -> bool:
        """Whether every joint keeps `margin` rad from its limits."""
        return bool(np.all(q >= self.lower + margin) and np.all(q <= self.upper - margin))

    def ik(self, target: Pose, q_seed: np.ndarray, tolerance: float = 1e-8) -> np.ndarray:
        """A joint vector inside the limits with `link_tcp` at `target`.

        Levenberg-Marquardt from `q_seed`, then from `home`, then from random postures (always the
        same ones, so equal calls give equal answers). tolerance: m and rad.
        Raises IkError when none of them arrives.
        """
        goal = target.to_se3()
        random = np.random.default_rng(0)
        low, high = np.maximum(self.lower, -np.pi), np.minimum(self.upper, np.pi)
        starts = [finite_vector("q_seed", q_seed, 7), self.home]
        starts += [random.uniform(low, high) for _ in range(IK_RESTARTS)]
        misses = []
        for start in starts:
            q, error = self._descend(goal, np.clip(start, self.lower, self.upper), tolerance)
            if np.abs(error).max() <= tolerance:
                return q
            misses.append(error)
        best = min(misses, key=np.linalg.norm)
        raise IkError(
            f"no posture within the joint limits reaches {target.position.round(4).tolist()} m, "
            f"quaternion {target.quaternion.round(4).tolist()}: nearest miss "
            f"{np.linalg.norm(best[:3]):.2g} m, {np.linalg.norm(best[3:]):.2g} rad"
        )

    def _descend(
        self, goal: pin.SE3, q: np.ndarray, tolerance: float
    ) -> tuple[np.ndarray, np.ndarray]:
        """Levenberg-Marquardt, projected onto the limits: the posture and its (6,) error."""
        damping = 1e-3
        error = difference(self.tcp_placement(q), goal)
        for _ in range(IK_ITERATIONS):
            if np.abs(error).max() <= tolerance or damping > 1e6:
                break
            jacobian = self.jacobian_tcp(q)
            # A joint that rests on its limit and is pushed outwards is left out, so that the
            # others find the way round.
            pull = jacobian.T @ error
            stuck = ((q <= self.lower) & (pull < 0)) | ((q >= self.upper) & (pull > 0))
            jacobian[:, stuck] = 0.0
            gram = jacobian @ jacobian.T + damping * np.eye(6)
            step = jacobian.T @ np.linalg.solve(gram, error)
            # Short steps stay near the seed: the elbow does not flip where it need not.
            step *= min(1.0, IK_STEP / max(np.abs(step).max(), IK_STEP))
            trial = np.clip(q + step, self.lower, self.upper)
            trial_error = difference(self.tcp_placement(trial), goal)
            if trial_error @ trial_error < error @ error:
                q, error, damping = trial, trial_error, max(damping * 0.2, 1e-12)
            else:
                damping *= 5.0
        return q, error

    def _placement(self, q: np.ndarray, frame: int) -> pin.SE3:
        pin.forwardKinematics(self._model, self._data, np.asarray(q, dtype=float))
        return pin.updateFramePlacement(self._model, self._data, frame).copy()


def urdf() -> str:
    """The arm's URDF as text."""
    return files("codesign_control").joinpath("xarm7.urdf").read_text(encoding="utf-8")
