"""What is wrong with a drive: causes in words, with the evidence for them.

health       all of what is wrong with Hall sensors, their wires and the encoder, in order
finding      what a detector yields
thresholds   how much is wrong: all of it in one table, with where each comes from
wiring       Hall wires exchanged, rotated, inverted, and where the ring of sensors stands
encoder      its zero, its direction, its lines; pole pairs; whether it stays with the shaft
late         which of a drive's angles comes late
sensors      inputs that never change, contacts, bounces, false pulses
edges        sensors off their places, magnets, edges that come late or do not repeat
motor        the flux linkage that the firmware takes the motor to have
motion       speed, currents and position errors of a run that turned a motor

A detector takes what was measured (`bench.signal`) or pieces of a run as they come, and yields findings: one function
or class for a kind of fault, whoever asks. `health` has the order in which Hall sensors and encoder are examined:
`bench hall check` has it examine a recording, `bench live` the motor as it turns (`bench.live.hall_sensors`). Nothing
here talks to a drive, reads a recording or prints.
"""
