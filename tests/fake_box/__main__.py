"""The fake control box as a program.

    python -m tests.fake_box --address 127.0.0.7 --log box.jsonl

Its switches: JSON lines on port 30900 of the same address, e.g. {"error": 31}, {"hung": true},
{"emergency_stop": 2}, {"drop": true}, {"offline": true}, {"delay": 0.02}; {} asks for the state.
"""

import argparse
import asyncio
import contextlib
import logging
from pathlib import Path

from tests.fake_box.server import Box


def main() -> None:
    """Runs until it is stopped."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.fake_box",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--address", default="127.0.0.7", help="any 127.x.y.z")
    parser.add_argument(
        "--log", type=Path, default=Path("box.jsonl"), help="every command, JSON lines"
    )
    parser.add_argument("--joints", type=float, nargs=7, help="first posture [rad]")
    parser.add_argument("--no-second-port", action="store_true", help="as firmware before 1.11")
    options = parser.parse_args()
    # Its lines about clients that have gone are no news here.
    logging.getLogger("asyncio").setLevel(logging.CRITICAL)
    box = Box(options.address, options.log, options.joints, not options.no_second_port)
    with contextlib.suppress(KeyboardInterrupt):
        asyncio.run(box.run())


if __name__ == "__main__":
    main()
