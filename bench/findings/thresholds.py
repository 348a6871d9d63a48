"""How much is wrong: every threshold of a finding, with where it comes from. What a measurement needs to be one at all
(how many samples, how strong a back-EMF) stands with the measurement, in `bench.signal`.

Thresholds of `bench hall check` are wide enough for the paper's motor, one of whose sensors stands 6.4 deg off (Table I
of Kim et al. 2011, 10.1109/TIE.2010.2098367). `bench live` judges a run that was made for something else: it tells
nonsense from a drive, not a good drive from a bad one. Where the two differ about one thing they stand side by side.
"""

from __future__ import annotations

import math

from bench.signal.waveforms.sectors import SECTOR_WIDTH

# -- is there enough to go by --------------------------------------------------------------------------------------

LEAST_TURNS = 2.0
"""Electrical revolutions, in all for any verdict, each way for a healthy one: each edge is then passed twice."""
LEAST_PASSAGES = 5
"""Of each edge each way: with 5, the 95 % interval of the mean is 1.24 times the jitter."""
SEEN_FOR = 0.5
"""s of samples from which on a run's position error and back-EMF are judged."""
LONG_ENOUGH = 1.0
"""s at a speed before it is judged: a start takes some tenths."""

# -- turns by Hall sensors and by encoder --------------------------------------------------------------------------

SAME, OTHER = 0.9, 0.95
"""`bench hall check`: how well edges repeat with the pole pairs that are right, at least, and with others, to be
believed (0..1, mean resultant length). 0.9 is a scatter of 26 deg, as far as misplaced sensors and their delay go."""
MULTIPLE = 0.75
"""`bench hall check`: electrical turns by Hall inputs for one by the encoder, below which the drive's pole pairs are a
multiple of the motor's, with which edges repeat too. Half is the largest ratio that such a multiple can have."""
RATIO_OFF = 0.25
"""`bench live`: of one, by which that ratio may be off. A run counts sectors in blocks, edge by edge as they come, and
does not know at which angle each edge came: it cannot see whether they repeat, so only the ratio tells, and a block's
ends cost up to a sector each."""
POLE_PAIR_OFF = 0.5
"""`bench live`: pole pairs by which the ratio may be off once the shaft has turned `ROUNDS`."""
ROUNDS = 2.0
"""Revolutions of the shaft, from which on half a pole pair shows in the ratio."""
COMPARED_TURNS = 3.0
"""Electrical revolutions from which on `bench live` compares: with fewer a block's ends weigh too much."""

# -- wires ---------------------------------------------------------------------------------------------------------

LEAST_SHARE = 0.95
"""Share of samples that a wiring must explain to be named: noise and false pulses cost a per cent or two."""
MARGIN = math.radians(12.0)
"""rad from an ideal edge in which samples do not count: as far as sensors of public tables are misplaced (8.4 deg at
most), with what hysteresis and delay add."""
LEAST_SEEN = 100
"""`bench live`: samples in each sector with which wires are judged. `bench hall check` asks for `LEAST_TURNS` instead:
a drive that is told to stand trembles over some sectors for seconds."""
STILL = 0.01
"""Share of time, and of the changes of the others, in which an input that never changes may have changed."""
IMPLAUSIBLE = 0.005
"""Share of edges to an illegal code or over a sector, beyond which a wiring that is right does not explain them."""
PULSES, PULSE_RATE = 3, 0.1
"""False pulses, in all and in a second, that are a fault: fewer come from switching a lamp."""

# -- where the sensors stand ---------------------------------------------------------------------------------------

DISPLACED = math.radians(8.0)
"""Off its place, from which on a sensor is displaced: the paper's worst is 6.4 deg off."""
SCATTER = math.radians(2.0)
"""Jitter from which on an edge is unsteady: four times the hysteresis of good sensors."""

# -- encoder and the angle of the flux -----------------------------------------------------------------------------

ZERO = math.radians(2.5)
"""Off the rotor flux, from which on the encoder's zero is off: more than the back-EMF is wrong by."""
LATE = 30e-6
"""s, from which on a delay is one: the fits are good to about 10 us."""
OFF_BY = SECTOR_WIDTH
"""rad rms of a position error, above which an angle is no estimate: a Hall sector alone tells it better."""

# -- motor ---------------------------------------------------------------------------------------------------------

PSI_OFF = 0.25
"""Of psi_f_hat, by which it may be off; likewise of R_s_hat. Magnets lose a tenth when hot, copper gains a quarter;
`bench accept` measures it with the speed held, and allows a tenth."""
LOST_VOLTAGE = 0.3
"""V that dead time and noise may add to a back-EMF."""
TOO_MUCH = 1.25
"""Of i_max, that the rms of the current vector may be: a controller overshoots."""
NO_SUM, LEAST_SUM = 0.5, 0.3
"""Of a phase current, rms, and A: what the sum of the three may be. Below the second it is noise and offsets."""

# -- speed ---------------------------------------------------------------------------------------------------------

SPEED_OFF, LEAST_SPEED = 0.5, 5.0
"""Of the speed that was asked for, and r/min, by which its mean may be off: a load may slow down a healthy motor."""
STANDS = 60.0
"""r/min that a motor may turn at which was asked to stand: the average-speed observer hunts about a stand."""
RISING = 0.05
"""Of the speed that was asked for, by which it changes while it is still on its way."""

# -- edges that a drive may be taught ------------------------------------------------------------------------------

LEARN_WITHIN = math.radians(0.5)
"""rad, the widest half of a 95 % confidence interval with which an edge is learnt: the hysteresis of good sensors."""
LEARN_SD = math.radians(2.0)
"""rad, the largest standard deviation with which an edge is taken from a filter."""
LEARN_MOTOR = {"psi_f_hat": 0.02, "R_s_hat": 0.1, "L_s_hat": 0.2}
"""What a filter learns of the motor, and the largest standard deviation with which it is taken, as a share."""
