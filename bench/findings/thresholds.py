"""How much is wrong: every threshold of a finding, with where it comes from. What a measurement needs to be one at all
(how many samples, how strong a back-EMF) stands with the measurement, in `bench.signal`.

Thresholds of `bench hall check` are wide enough for the paper's motor, one of whose sensors stands 6.4 deg off (Table I
of Kim et al. 2011, 10.1109/TIE.2010.2098367). `bench live` judges a run that was made for something else: it tells
nonsense from a drive, not a good drive from a bad one. Where the two differ about one thing they stand side by side.
"""

from __future__ import annotations

import math

from bench.signal.hall_edges import SEEMS
from bench.signal.waveforms.sectors import SECTOR_WIDTH

# -- is there enough to go by --------------------------------------------------------------------------------------

LEAST_TURNS = 2.0
"""Electrical revolutions, in all for any verdict, each way for a healthy one: each edge is then passed twice."""
LEAST_REACH = 1.5
"""Electrical revolutions between the farthest places that the shaft was at: each edge is then passed on both sides."""
LEAST_PASSAGES = 5
"""Of each edge each way: with 5, the 95 % interval of the mean is 1.24 times the jitter."""
BLIND_PASSAGES = 12
"""Of each edge, without an encoder: each is then measured by the revolutions around it."""
SEEN_FOR = 0.5
"""s of samples from which on a run's position error and back-EMF are judged."""
LONG_ENOUGH = 1.0
"""s at a speed before it is judged: a start takes some tenths."""
KNOWN_FOR = 0.1
"""Of the last third at a speed, over which it must be known to be judged: what was lost may be a tenth as well."""
LOST_SHARE = 0.05
"""Share of the samples, or edges, that are lost, from which on a result says so: of less the others tell as well."""

# -- turns by Hall sensors and by encoder --------------------------------------------------------------------------

WHOLE = 0.05
"""Pole pairs by which a ratio may miss a whole number, or a tenth of that of ten: it is known to some thousandths."""

# -- what a drive tells twice ---------------------------------------------------------------------------------------

FEW_RECORDS, CONTRADICT, EXCHANGED = 20, 0.1, 0.95
"""EDGES records, or samples, with which they are compared; share that may contradict, for an interrupt that comes late
misses an edge; and share that follows from the one before with the codes exchanged, where a rotor may rock as well."""
AT_RANDOM = 1.5
"""Changes of the channel `hall` for each edge, above which they are no edges: a bounce is one of both, or none."""
FEW_BEATS = 3
"""Heartbeats that contradict the channel `status`, from which on that is told: each of the two may come late once."""
COUNTS_OFF = 2
"""Edges by which a heartbeat's count may be off: an edge may come while it is made."""
FASTEST_EDGES = 1e6
"""Edges a second that no input capture follows."""

# -- wires ---------------------------------------------------------------------------------------------------------

LEAST_SHARE = 0.95
"""Share of samples that a wiring must explain to be named: noise and false pulses cost a per cent or two."""
MARGIN = math.radians(12.0)
"""rad from an ideal edge in which samples do not count: as far as sensors of public tables are misplaced (8.4 deg at
most), with what hysteresis and delay add."""
LEAST_SEEN = 100
"""`bench live`: samples in each sector with which wires are judged of a shaft that turned less than `LEAST_TURNS`: with
wires exchanged a motor may not start. `bench hall check` turns it, or asks for more."""
STILL = 0.01
"""Share of time, and of the changes of the others, in which an input that never changes may have changed."""
DEAD_TURNS = 3.0
"""Electrical revolutions without a change of an input, from which on it is dead."""
OFTEN_AWAY, ONE_SIDED = 8, 0.15
"""Half revolutions in which an input reads one wrong level, and such a share of them the other: eight are so by chance
once in 128."""
AS_OFTEN, FEW_BESIDE = 0.5, 10
"""Of these, in which the input must be seen to return to that level; and of returns to it, that may be to the other:
or so many for each of these where the input is away for long, for where it bounces there are many more."""
PART = 0.1
"""Of a half revolution, that is wrong in the mean of those that are, unless the input is seen to return: else it is an
edge that lies far off."""
SEEN_OF = 0.3
"""Of the revolutions by the sectors, with which that is told, or with fewer where the time at each level agrees."""
SHORTLY, BESIDES = 0.1, 0.4
"""Share of the way, up to which all that returns must be on that side, too; and of the input that is away the most."""
SELDOM, OFTENER = 0.8, 1.5
"""Of the changes of the input in the middle, below which one misses some, and above which they are not all edges."""
SELDOM_AWAY, BROKEN = 4, 2
"""Half revolutions with which that is told as well, where so many are wrong wholly, or the input is away for `LONG`."""
LONG, FEW_LONG, MANY = 5e-3, 1e-3, 16
"""s, longer than a false pulse lasts; and than one surely lasts, where there are fewer returns than so many."""
PULSES, PULSE_RATE = 3, 0.1
"""False pulses, in all and in a second, that are a fault: fewer come from switching a lamp."""
BOUNCES = 0.005
"""Share of an input's edges that may bounce: a sensor with hysteresis never does."""
SET = SEEMS
"""rad by which the ring may stand off where the drive takes it to stand: as far as a sensor may (`DISPLACED`)."""
NAMED = math.radians(20.0)
"""rad from where the ring should stand within which a wiring is named after it: rings sit at any angle."""

# -- where the sensors stand ---------------------------------------------------------------------------------------

DISPLACED = math.radians(9.0)
"""Off its place against the mean of the three, from which on a sensor is displaced, or its edges apart: of 16 real
motors the worst is 8.4 deg off, 3.0 rms; the paper's 6.4."""
TABLE_SCATTER = (math.radians(1.8), math.radians(5.4))
"""rad, standard deviation that other tools' tables of Hall sensors have of their own: of a good detection, of a bad."""
SURE = 3.0
"""Standard errors beyond a limit, from which on it is exceeded."""
SCATTER, SCATTER_ALL = math.radians(2.0), math.radians(4.0)
"""Jitter from which on an edge is unsteady: four times the hysteresis of good sensors; as much more without an encoder,
where a speed that swings adds to it, or where pole pairs are not told apart: in real motors 1.4 deg rms."""
CLOUDED = 0.3
"""Share of edges far from their places, beyond which nothing more is said of an encoder while inputs are disturbed."""
HIDDEN = math.radians(5.0)
"""rad for each of its edges that an input is away in returns, beyond which likewise: they cover edges."""
MOVES = 1.6
"""Times the jitter of the others, that edges of a sensor scatter which move with the speed, where no encoder tells."""
TWICE = 2.0
"""Times the slow revolutions that the fast ones must be, that edges without an encoder are called late."""
SWINGING = 10.0 * math.tau
"""Electrical rad/s, below which a speed that swings scatters edges that no encoder measures."""
TOGETHER = 0.5
"""How alike passages that follow each other are scattered, beyond which no sensor does it."""
ASIDE = 0.05
"""Share of edges far from their places, beyond which they do not repeat."""
PAIR_OFF, PAIRS_OFF = math.radians(6.0), math.radians(3.0)
"""rad by which one pole pair may stand off, and edges of pole pairs may differ, rms: 0.85 to 1.36 in real motors."""
ECCENTRIC, SINE = math.radians(0.35), math.radians(4.0)
"""rad of the shaft, and electrical, by which a disc or a ring may swing: 0.1 mm at a radius of 16 mm."""
LEFT = 0.4
"""Of what edges differ by over a turn of the shaft, that may be left beside a swing once a turn: uneven magnets leave
more, for any of them have some of it."""
TOLD_EVEN, EVEN_MAGNETS = 10, math.radians(1.6)
"""Pole pairs, with fewer of which uneven magnets look like a swing by chance; and what differences of magnets that are
even leave beside one, rms: 1.4 in real motors."""
LATE_EDGES, TOLD_LATE = 350e-6, 40e-6
"""s by which edges may come late, unless that is `DISPLACED` at the fastest; and from which on it is told: 66 us
falling and 150 us rising were measured on e-bikes, 275 us between the two on a hub motor."""
BEATS = 2.0 * math.sqrt(3.0)
"""Times the resolution of edges, rms, that a jump must be: a step of the times, from end to end, for they stay at one
while the speed beats with it."""
DRIFTS = 1.5
"""Turns of the shaft, with which a drift is told from what comes once a turn."""
OFTEN = 3
"""Jumps of all edges together, from which on the encoder slips again and again."""
MOST_LATE = 3e-3
"""s that edges or encoder may be late: what is more is a slip."""
NEAR_ONE = 0.004
"""Of the ratio of encoder to sectors, that a drift may come to: more is lines, or pole pairs."""
SLIPPED = math.radians(1.5)
"""rad by which all edges may jump, or drift in all: what is less does no harm, and is taken out."""
WANDERS, WITH_EACH = 2.0, 0.8
"""Times the least jump that is a slip, and of what each edge scatters, that all edges of a revolution may scatter
together, rms: the mean of six that scatter each by themselves does so by 0.41 of it."""
NO_HYSTERESIS, BACKWARDS = math.radians(6.0), math.radians(-1.5)
"""rad of hysteresis in the mean of all edges, above which, and below which, it is none."""

# -- encoder and the angle of the flux -----------------------------------------------------------------------------

ZERO = math.radians(2.5)
"""Off the rotor flux, from which on the encoder's zero is off: more than the back-EMF is wrong by."""
LATE = 50e-6
"""s, from which on a delay is one: it is told where it is known to 25 us (95 %), or to a tenth of it."""
OFF_BY = SECTOR_WIDTH
"""rad rms of a position error, above which an angle is no estimate: a Hall sector alone tells it better."""

# -- motor ---------------------------------------------------------------------------------------------------------

TELLING = {"R_s_hat": 1.5, "L_s_hat": 1.7, "psi_f_hat": 1.3}
"""Factor by which a parameter of the motor must be off. Copper that is 125 K warmer has 1.5 times the resistance; L_q
is 1.6 times L_d in one of the motors shipped, and iron that saturates takes a third; hot magnets lose a tenth."""
SURELY = 1.2
"""The same, by three standard deviations."""
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
LEARN_ASIDE = 0.02
"""Share of passages far from their edges, beyond which none is learnt: something moved, if only for a while."""
LEARN_LEG = 3.0
"""Electrical revolutions one way, after which a slip of the encoder at the reversal shows."""
HYSTERESIS = math.radians(0.2), math.radians(2.0)
"""rad of hysteresis that sensors have that are well: what a slip between the two directions may add hides in it."""
LEARN_SD = math.radians(2.0)
"""rad, the largest standard deviation with which an edge is taken from a filter."""
LEARN_MOTOR = {"psi_f_hat": 0.02, "R_s_hat": 0.1, "L_s_hat": 0.25}
"""What a filter learns of the motor, and the largest standard deviation with which it is taken, as a share."""
