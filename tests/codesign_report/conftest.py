import pytest
from synthetic_trial import SyntheticTrial, write_bag

from codesign_report import read_trial


@pytest.fixture(scope="session")
def trial():
    return SyntheticTrial()


@pytest.fixture(scope="session")
def bag(tmp_path_factory, trial):
    """A good trial; tests must not write into it."""
    return write_bag(tmp_path_factory.mktemp("run") / "stock-seed3", trial)


@pytest.fixture(scope="session")
def recording(bag):
    return read_trial(bag)
