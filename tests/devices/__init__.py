"""A test device that speaks HBP and misbehaves on request, written from protocol/SPEC.md alone.

It has numbers and frames of `protocol` (`spec`, `carriers`), but no requests, states (`device`) and streams. `motor` is
a shaft that turns, `vocabulary` what it calls its channels, `faults` what it
gets wrong.

In a test, over a pty, TCP or CAN in real time, or in virtual time ("bytes", "CAN": `device.link` is then the link):

    from tests.devices import serving

    with serving("full", ["stop-ignored"], "tcp", after=0.5) as device:
        ...  # connect to device.carrier.target
    assert len(device.stops) >= 3  # and device.state, device.outputs_on, device.seen["START"] as they truly are

"own" in the place of "full" is a drive of six channels and three parameters of its own names, without encoder, edges,
currents.
"""

from tests.devices.faults import FAULTS, build
from tests.devices.serving import serving
from tests.devices.vocabulary import FULL, OWN

__all__ = ["FAULTS", "FULL", "OWN", "build", "serving"]
