"""`python -m tests.devices [--vocabulary own] [--link tcp] [--fault NAME]…`: serve until it is killed."""

from __future__ import annotations

import argparse
import signal
import threading

from tests.devices.faults import FAULTS, build
from tests.devices.serving import CARRIERS, run
from tests.devices.vocabulary import VOCABULARIES


def main() -> None:
    """Print the target, then serve."""
    parser = argparse.ArgumentParser(prog="python -m tests.devices", description=__doc__)
    parser.add_argument("--vocabulary", choices=VOCABULARIES, default="full")
    parser.add_argument("--link", choices=("pty", "tcp", "slcan"), default="pty")
    parser.add_argument("--fault", action="append", default=[], choices=FAULTS, metavar="NAME", help="repeatable")
    parser.add_argument("--list", action="store_true", help="show the faults and end")
    parser.add_argument("--after", type=float, default=1.0, metavar="S", help="s after START, for faults that wait")
    parser.add_argument("--pwm-hz", type=int, default=1000)
    given = parser.parse_args()
    if given.list:
        for name, fault in FAULTS.items():
            print(f"{name:26} {(fault.__doc__ or '').splitlines()[0]}")
        return
    if "foreign-stop" in given.fault and given.link != "slcan":
        parser.error("foreign-stop needs a CAN bus: --link slcan")
    device = build(VOCABULARIES[given.vocabulary], given.fault, after=given.after, pwm_hz=given.pwm_hz)
    device.carrier = CARRIERS[given.link]()
    stop = threading.Event()
    for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
        signal.signal(number, lambda *_: stop.set())
    print(f"target: {device.carrier.target}", flush=True)
    run(device, stop)
    device.carrier.close()


main()
