"""The device side of HBP: sessions, states, streams, and how their frames wait for a link. No I/O, no clock."""
