"""A second solver to check the simulator against: implicit, in float64, by other formulas.

Backward Euler with Newton's method on co-rotational tetrahedra. Shape functions come from inverted
nodal coordinates, rotations and principal stresses from singular value decompositions, lumped mass
from tetrahedra. Shared with the simulator are the mesh, the material law and the contact law (see
implicit_contact.py): what is solved is the same, how it is solved is not.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from implicit_contact import Contact
from scipy import sparse
from scipy.sparse.linalg import splu

GRAVITY = np.array([0.0, 0.0, -9.81])
# Antisymmetric matrices, the directions in which a rotation turns, and the axes each one mixes.
_TWISTS = [
    (np.array([[0, -1, 0], [1, 0, 0], [0, 0, 0]]) / np.sqrt(2), (0, 1)),
    (np.array([[0, 0, 0], [0, 0, -1], [0, 1, 0]]) / np.sqrt(2), (1, 2)),
    (np.array([[0, 0, 1], [0, 0, 0], [-1, 0, 0]]) / np.sqrt(2), (0, 2)),
]


class Elasticity:
    """Forces, stiffness and stress of co-rotational linear tetrahedra.

    Args:
        nodes: (N, 3) rest positions, m.
        tets: (T, 4) node indices.
        young_modulus, poisson_ratio: Pa, -.
    """

    def __init__(self, nodes, tets, young_modulus: float, poisson_ratio: float) -> None:
        # Columns of the inverse of [1 x y z] are the coefficients of the shape functions.
        corners = np.concatenate([np.ones((len(tets), 4, 1)), nodes[tets]], axis=2)
        self.gradients = np.linalg.inv(corners)[:, 1:].transpose(0, 2, 1)  # (T, 4, 3)
        self.volumes = np.abs(np.linalg.det(corners)) / 6
        self.tets, self.nodes = tets, len(nodes)
        self.shear = young_modulus / (2 + 2 * poisson_ratio)
        self.lam = 2 * self.shear * poisson_ratio / (1 - 2 * poisson_ratio)
        dof = (3 * tets[:, :, None] + np.arange(3)).reshape(-1, 12)
        self._entries = np.repeat(dof, 12, axis=1).ravel(), np.tile(dof, 12).ravel()

    def forces(self, x: np.ndarray) -> np.ndarray:
        """Elastic node forces (N, 3) in N at positions x (N, 3)."""
        u, stretches, vt = self._polar(x)
        piola = u * self._principal_stresses(stretches)[:, None, :] @ vt
        pull = -np.einsum("t,tij,taj->tai", self.volumes, piola, self.gradients)
        return self.summed(pull)

    def stiffness(self, x: np.ndarray) -> sparse.csr_matrix:
        """Minus the derivative of the forces (3N, 3N), N/m.

        A rotation's derivative by F has the twists as eigenvectors, 2 / (s_i + s_j) the values.
        """
        u, stretches, vt = self._polar(x)
        rotation = (u @ vt).reshape(-1, 9)
        tangent = 2 * self.shear * np.eye(9)
        tangent = tangent + self.lam * rotation[:, :, None] * rotation[:, None, :]
        turning = self.lam * (stretches.sum(axis=1) - 3) - 2 * self.shear
        for twist, (i, j) in _TWISTS:
            way = (u @ twist @ vt).reshape(-1, 9)
            share = turning * 2 / (stretches[:, i] + stretches[:, j])
            tangent += share[:, None, None] * way[:, :, None] * way[:, None, :]
        # d F_ij / d x_ak = gradient_aj for k = i, as a (9, 12) matrix.
        strain = np.einsum("taj,ik->tijak", self.gradients, np.eye(3)).reshape(-1, 9, 12)
        local = strain.transpose(0, 2, 1) @ (self.volumes[:, None, None] * tangent) @ strain
        shape = (3 * self.nodes, 3 * self.nodes)
        return sparse.csr_matrix((local.ravel(), self._entries), shape=shape)

    def von_mises(self, x: np.ndarray) -> np.ndarray:
        """Von Mises value (T,) of the co-rotated stress, from its principal values, Pa."""
        a, b, c = self._principal_stresses(self._polar(x)[1]).T
        return np.sqrt(((a - b) ** 2 + (b - c) ** 2 + (c - a) ** 2) / 2)

    def summed(self, values: np.ndarray) -> np.ndarray:
        """Corner values (T, 4, K) added up per node, (N, K)."""
        total = np.zeros((self.nodes, values.shape[2]))
        np.add.at(total, self.tets, values)
        return total

    def _polar(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """U, principal stretches and V^T of every deformation gradient, U V^T a rotation."""
        u, stretches, vt = np.linalg.svd(np.einsum("tai,taj->tij", x[self.tets], self.gradients))
        mirrored = np.linalg.det(u @ vt) < 0
        u[mirrored, :, 2] *= -1
        stretches[mirrored, 2] *= -1
        return u, stretches, vt

    def _principal_stresses(self, stretches: np.ndarray) -> np.ndarray:
        dilation = stretches.sum(axis=1, keepdims=True) - 3
        return 2 * self.shear * (stretches - 1) + self.lam * dilation


class ImplicitBlock:
    """A soft block among obstacles, stepped by backward Euler.

    Args:
        elasticity: of its tetrahedra.
        nodes: (N, 3) where it starts, at rest, m.
        density: kg/m^3.
        contacts: with each obstacle.
        gravity: (3,) m/s^2.
    """

    def __init__(
        self,
        elasticity: Elasticity,
        nodes: np.ndarray,
        density: float,
        contacts: Sequence[Contact] = (),
        gravity: np.ndarray = GRAVITY,
    ) -> None:
        quarters = np.repeat(elasticity.volumes[:, None, None] / 4, 4, axis=1)
        self.elasticity, self.contacts = elasticity, contacts
        self.x, self.v = nodes.copy(), np.zeros_like(nodes)
        self.mass = density * elasticity.summed(quarters)  # (N, 1)
        self.weight = self.mass * gravity
        self.touches = [contact.touch(nodes) for contact in contacts]

    def step(self, dt: float, tolerance: float = 1e-6, most: int = 40) -> None:
        """One step of dt seconds, to a residual force below `tolerance` (N).

        Newton's method, each correction halved until the residual falls.

        Raises:
            RuntimeError: not converged after `most` iterations.
        """
        start, predicted = self.x, self.x + dt * self.v
        x, left = start, self._residual(start, predicted, dt)
        for _ in range(most):
            size = np.linalg.norm(left)
            if size < tolerance:
                break
            matrix = self.elasticity.stiffness(x) + sparse.diags(np.repeat(self.mass / dt**2, 3))
            for contact, touch in zip(self.contacts, self.touches, strict=True):
                matrix = matrix + contact.node_stiffness(touch)
            way = splu(matrix.tocsc()).solve(left.ravel()).reshape(-1, 3)
            for share in 0.5 ** np.arange(8):
                left = self._residual(x + share * way, predicted, dt)
                if np.linalg.norm(left) < size:
                    break
            x = x + share * way
        else:
            raise RuntimeError(f"residual {size:.2g} N after {most} iterations")
        self.x, self.v = x, (x - start) / dt
        for contact, touch in zip(self.contacts, self.touches, strict=True):
            contact.keep(touch)

    def contact_force(self, index: int) -> np.ndarray:
        """Force (3,) in N of one obstacle on the block at the end of the last step."""
        return self.touches[index].force.sum(axis=0)

    def _residual(self, x: np.ndarray, predicted: np.ndarray, dt: float) -> np.ndarray:
        """Force (N, 3) left after accelerating the mass; leaves the contacts in `touches`."""
        self.touches = [contact.touch(x) for contact in self.contacts]
        force = self.weight + self.elasticity.forces(x) - self.mass * (x - predicted) / dt**2
        for contact, touch in zip(self.contacts, self.touches, strict=True):
            force = force + contact.node_forces(touch)
        return force
