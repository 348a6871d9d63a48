"""Whether a device conforms to HBP: checks of what protocol/SPEC.md demands, from outside, with evidence for each.

`checks` says what a check is, `probe` speaks to the device frame by frame, the modules named for a part of SPEC hold
the checks, `run` runs them and restores the device, `claim` sums up the result.
"""
