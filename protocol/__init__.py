"""HBP, the Hall Bench Protocol: framing, messages, streams, both ends of a session, and the links below them.

`SPEC.md` beside this file is the normative text. The core takes bytes and times as arguments: it does no I/O
and reads no clock; only `protocol.links` touches the outside world.
"""

__version__ = "0.1.0"  # of all three packages, and of what pip installs
