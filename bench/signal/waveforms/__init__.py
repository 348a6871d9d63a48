"""What an acceptance test measures on recorded waveforms: steps, harmonics, frequency responses, Hall edges.

Pure functions of numpy arrays. `t` is (n,) in s and uniform, values are (n,). Nothing here talks to a drive, knows a
limit or gives a verdict.

What is not finite, not of one length or not uniform in time is refused with a ValueError of one line, because a number
measured over a gap is worth nothing. What did not happen (never settled, never rose) is None; a statistic of no samples
is NaN, with its count beside it.
"""

from bench.signal.waveforms.frequency import Spectrum, sine_response, spectrum
from bench.signal.waveforms.harmonics import Fundamental, Thd, fundamental, thd, thd_by_angle
from bench.signal.waveforms.sectors import FORWARD, REVERSE, EdgeOffsets, edge_offsets, hall_offset, sector_of_angle
from bench.signal.waveforms.steps import Settled, StepResponse, settled, step_response

__all__ = [
    "REVERSE", "FORWARD", "EdgeOffsets", "Fundamental", "Settled", "Spectrum", "StepResponse", "Thd", "edge_offsets",
    "fundamental", "hall_offset", "sector_of_angle", "settled", "sine_response", "spectrum", "step_response", "thd",
    "thd_by_angle",
]  # fmt: skip
