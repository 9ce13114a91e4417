"""How fast the simulator is, beside MuJoCo's flex, in control steps of a grasp."""

from codesign_sim.bench.cases import Case, Rate, Result
from codesign_sim.bench.machine import describe_machine, full_lanes
from codesign_sim.bench.run import cases, ratios, run

__all__ = ["Case", "Rate", "Result", "cases", "describe_machine", "full_lanes", "ratios", "run"]
