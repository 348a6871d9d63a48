"""What is wrong with a drive: causes in words, with the evidence for them.

finding      what a detector yields
thresholds   how much is wrong: all of it in one table, with where each comes from
wiring       Hall wires exchanged, inverted, open, shorted
pole_pairs   electrical revolutions by the Hall sensors beside those by the encoder
encoder      its zero, its direction
late         which of a drive's angles comes late
sensors      inputs that never change, sensors off their places, edges that do not stand still, false pulses, contacts
motor        the flux linkage that the firmware takes the motor to have
motion       speed, currents and position errors of a run that turned a motor

A detector takes what was measured (`bench.signal`) or pieces of a run as they come, and yields findings: one function
or class for a kind of fault, whoever asks. `bench hall check` asks with a recording (`bench.findings.health` has the
order), `bench live` while the motor turns (`bench.live.plausible`), `bench accept` in its tests. Nothing here talks to
a drive, reads a recording or prints.
"""
