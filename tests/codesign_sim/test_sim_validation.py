"""Every validation case of the simulator holds."""

import pytest

from codesign_sim.validation import CASES, Check, run
from codesign_sim.validation.bending import elastica


@pytest.mark.parametrize("name", CASES)
def test_case(name):
    ((_, checks),) = run([name])
    failed = [
        f"{c.name}: {c.measured:.6g}, expected {c.expected:.6g}" for c in checks if not c.passed
    ]
    assert checks
    assert not failed


def test_unknown_case_is_named():
    with pytest.raises(ValueError, match="no validation case 'nonsense'; choose from squeeze"):
        list(run(["nonsense"]))


@pytest.mark.parametrize(
    ("check", "passed"),
    [
        (Check("", 10.0, 10.4, 0.5, ""), True),
        (Check("", 10.0, 9.4, 0.5, ""), False),
        (Check("", 10.0, 99.0, 0.0, "", at_least=True), True),
        (Check("", 10.0, 9.9, 0.0, "", at_least=True), False),
        (Check("", 10.0, float("nan"), 1e9, ""), False),
    ],
)
def test_verdicts(check, passed):
    assert check.passed == check.as_dict()["passed"] == passed


@pytest.mark.parametrize(("load", "down"), [(1.0, 0.30172), (2.0, 0.49346), (5.0, 0.71379)])
def test_elastica_against_bisshopp_and_drucker(load, down):
    # Bisshopp and Drucker 1945, "Large deflection of cantilever beams", table 1.
    assert elastica(load)[0] == pytest.approx(down, abs=2e-5)
