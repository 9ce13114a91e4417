"""Stress by finger shape: known derivatives, and smooth enough to differentiate."""

import numpy as np
import pytest

from codesign_sim import Block, Material, SurfaceMesh
from codesign_sim.pads import flat_pads
from codesign_sim.sensitivity import Grasp, held_stress, roughness, stress_gradient

GRASP = Grasp(block=Block.tofu(600))
SMOOTH = 10.0  # Pa rms


def boxes(width=0.02, thicker=0.0, sideways=0.0):
    """Sharp pads 50 mm tall, their faces moved inwards by `thicker` (metres)."""
    x0, x1 = sideways - width / 2, sideways + width / 2
    return (
        SurfaceMesh.box((x0, -thicker, -0.025), (x1, 0.01, 0.025)),
        SurfaceMesh.box((x0, -0.01, -0.025), (x1, thicker, 0.025)),
    )


@pytest.fixture(scope="module")
def by_closing():
    widths = np.linspace(0.0245, 0.0270, 21)
    return widths, held_stress([boxes()] * len(widths), GRASP, widths)


def test_gradient_equals_the_slope_of_a_fine_sweep(by_closing):
    """A pad thicker by t closes like a gap narrower by 2 t; 2 % of the sweep's slope at 26 mm."""
    widths, stress = by_closing
    found = stress_gradient(lambda p: boxes(thicker=p[0]), [0.0], [0.25e-3], GRASP)
    for figures, gradient in (
        (stress.top10, found.top10_gradient),
        (stress.median, found.median_gradient),
    ):
        slope = np.polynomial.Polynomial.fit(widths, figures, 4).deriv()(GRASP.width)
        assert gradient[0] == pytest.approx(-2 * slope, rel=0.02)


def test_several_parameters_share_one_simulation():
    both = stress_gradient(lambda p: boxes(p[0], p[1]), [0.02, 0.0], [1e-3, 0.25e-3], GRASP)
    alone = stress_gradient(lambda p: boxes(thicker=p[0]), [0.0], [0.25e-3], GRASP)
    assert both.lanes == 5
    assert both.top10_gradient[1] == pytest.approx(alone.top10_gradient[0], rel=1e-3)
    assert both.top10 == pytest.approx(alone.top10, rel=1e-4)
    assert both.held.shape == (2, 2)
    assert both.cpu_seconds > 0


def test_smooth_over_the_closing_width(by_closing):
    widths, stress = by_closing
    assert stress.held.all()
    assert roughness(widths, stress.top10) < SMOOTH
    assert roughness(widths, stress.median) < SMOOTH


def test_smooth_over_the_pad_width():
    """Steps of 0.5 mm, a sixteenth of a cell; the median is rougher, see docs/simulator.md."""
    widths = np.linspace(0.014, 0.026, 25)
    stress = held_stress([boxes(w) for w in widths], GRASP)
    assert stress.held.all()
    assert roughness(widths, stress.top10) < SMOOTH


def test_roughness_is_what_a_polynomial_leaves():
    x = np.linspace(0.01, 0.03, 200)
    smooth = 3 + 2e3 * x - 1e5 * x**2 + 4e6 * x**3
    noise = 5 * np.sign(np.sin(1e6 * np.arange(200)))
    assert roughness(x, smooth) < 1e-9
    assert roughness(x, smooth + noise) == pytest.approx(5, rel=0.05)


def test_a_side_that_drops_the_block_has_no_gradient():
    """At 27.6 mm the pads just hold; 0.5 mm thinner each, they do not."""
    grasp = Grasp(width=0.0276, block=GRASP.block)
    found = stress_gradient(lambda p: boxes(thicker=p[0]), [0.0], [0.5e-3], grasp)
    assert found.held.tolist() == [[False, True]]
    assert np.isnan(found.top10_gradient).all()


def test_fingers_that_drop_the_block_are_refused():
    slippery = Grasp(block=GRASP.block, material=Material(friction=0.05))
    with pytest.raises(ValueError, match="drop the block at a width of 26 mm"):
        stress_gradient(lambda p: boxes(), [0.0], [1e-3], slippery)


def test_steps_must_fit_the_parameters():
    with pytest.raises(ValueError, match="steps"):
        stress_gradient(lambda p: boxes(), [0.0, 1.0], [1e-3], GRASP)
    with pytest.raises(ValueError, match="above 0"):
        stress_gradient(lambda p: boxes(), [0.0], [0.0], GRASP)


# ------------------------------------------------------------------------------- the pads


def test_pad_measures_what_it_says():
    left, right = flat_pads(0.03, 0.04, edge_radius=0.002, offset=0.005)
    assert np.ptp(left.vertices, axis=0) == pytest.approx([0.03, 0.01, 0.04])
    assert left.vertices[:, 1].min() == pytest.approx(0, abs=1e-12)
    assert left.vertices[:, 2].mean() == pytest.approx(0.005)
    assert right.vertices == pytest.approx(left.vertices * [1, -1, 1])
    face = left.vertices[left.vertices[:, 1] < 1e-9]
    assert np.ptp(face[:, 0]) == pytest.approx(0.03 - 2 * 0.002)


def test_a_tilted_face_opens_towards_the_tips():
    left, _ = flat_pads(0.03, 0.04, edge_radius=0.001, tilt=0.1)
    face = left.vertices[np.argsort(left.vertices[:, 1] - 0.1 * left.vertices[:, 2])[:4]]
    slope = np.polyfit(face[:, 2], face[:, 1], 1)
    assert slope == pytest.approx([np.tan(0.1), 0.0], abs=1e-9)


def test_a_fillet_must_leave_a_face():
    with pytest.raises(ValueError, match=r"edge radius is 0\.01 m"):
        flat_pads(0.02, 0.04, edge_radius=0.01)
