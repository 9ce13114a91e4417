"""Elastic material and the largest stable time step."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import scipy.sparse as sparse
from scipy.sparse.linalg import eigsh

from codesign_sim.checks import require_finite, require_not_negative, require_positive
from codesign_sim.soft_object import SoftObject


@dataclass(frozen=True)
class Material:
    """Isotropic elasticity, density and the friction of the block's surface.

    Args:
        young_modulus: E in Pa; the paper draws 8-10 kPa (section IV).
        poisson_ratio: nu, above -1 and below 0.5 (constant-strain tetrahedra lock near 0.5).
        density: kg/m^3.
        friction: Coulomb coefficient against fingers and table, at least 0.
    Raises:
        ValueError: a value outside these limits.
    """

    young_modulus: float = 9e3
    poisson_ratio: float = 0.3125
    density: float = 1020.0
    friction: float = 0.5

    def __post_init__(self) -> None:
        require_positive("Young's modulus", self.young_modulus, (), "Pa")
        require_positive("density", self.density, (), "kg/m^3")
        require_finite("Poisson's ratio", self.poisson_ratio, ())
        if not -1 < self.poisson_ratio < 0.5:
            raise ValueError(
                f"Poisson's ratio is {self.poisson_ratio:g}; it must lie between -1 and 0.5 "
                "(use 0.49 for a nearly incompressible material)"
            )
        require_not_negative("friction coefficient", self.friction)

    @property
    def lame(self) -> tuple[float, float]:
        """Lame constants (mu, lambda) in Pa."""
        e, nu = self.young_modulus, self.poisson_ratio
        return e / (2 * (1 + nu)), e * nu / ((1 + nu) * (1 - 2 * nu))


def stable_time_step(
    block: SoftObject, material: Material, contact_stiffness: float, stiffness_damping: float
) -> float:
    """Largest time step in seconds at which the smallest vibration does not grow.

    A vibration of frequency w stepped by symplectic Euler with forces at x + beta v stays bounded
    while dt^2 + 2 beta dt < 4 / w^2. The largest w is found with the whole surface in contact,
    normal and tangential springs alike.
    """
    # Rounded upwards, so that randomised materials share a few cached answers.
    modulus = float(np.ceil(material.young_modulus / material.density * 10) / 10)
    contact = float(np.ceil(contact_stiffness / material.density / 100) * 100)
    poisson = min(float(np.ceil(material.poisson_ratio * 100) / 100), 0.4999)
    poisson = max(poisson, material.poisson_ratio)
    square = _largest_eigenvalue(block, modulus, poisson, contact)
    return float(np.sqrt(stiffness_damping**2 + 4 / square) - stiffness_damping)


@lru_cache(maxsize=256)
def _largest_eigenvalue(
    block: SoftObject, modulus: float, poisson_ratio: float, contact_stiffness: float
) -> float:
    """Largest w^2 in rad^2/s^2 of the block at unit density."""
    elastic, contact = _stiffness(block, Material(modulus, poisson_ratio)), _contact_matrix(block)
    scale = sparse.diags(1 / np.sqrt(np.repeat(block.node_volumes, 3)))
    matrix = scale @ (elastic + contact_stiffness * contact) @ scale
    start = np.random.default_rng(0).standard_normal(matrix.shape[0])
    top = eigsh(matrix, k=1, tol=1e-3, v0=start, return_eigenvectors=False)[0]
    return 1.002 * float(top)


def _stiffness(block: SoftObject, material: Material) -> sparse.csr_matrix:
    """Linear elastic stiffness (3N, 3N) at rest."""
    mu, lam = material.lame
    inverse = block.inverse_edges
    gradient = np.concatenate([-inverse.sum(axis=1, keepdims=True), inverse], axis=1)  # (T, 4, 3)
    same = np.einsum("tak,tbk->tab", gradient, gradient)
    local = (
        lam * np.einsum("tai,tbj->taibj", gradient, gradient)
        + mu * np.einsum("taj,tbi->taibj", gradient, gradient)
        + mu * np.einsum("tab,ij->taibj", same, np.eye(3))
    ) * block.volumes[:, None, None, None, None]
    return _assemble(block.tetrahedra, local, len(block.nodes))


def _contact_matrix(block: SoftObject) -> sparse.csr_matrix:
    """Penalty matrix (3N, 3N) per unit stiffness with every surface triangle touching."""
    corner = np.full((3, 3), 1 / 6) + np.eye(3) / 2  # shape functions at the three points
    local = np.einsum("qa,qb,ij->aibj", corner, corner, np.eye(3)) / 3
    scaled = block.surface_areas[:, None, None, None, None] * local[None]
    return _assemble(block.surface_triangles, scaled, len(block.nodes))


def _assemble(items: np.ndarray, local: np.ndarray, nodes: int) -> sparse.csr_matrix:
    dof = (3 * items[:, :, None] + np.arange(3)).reshape(len(items), -1)
    size = dof.shape[1]
    rows = np.repeat(dof, size, axis=1).ravel()
    columns = np.tile(dof, (1, size)).ravel()
    return sparse.csr_matrix((local.ravel(), (rows, columns)), shape=(3 * nodes, 3 * nodes))
