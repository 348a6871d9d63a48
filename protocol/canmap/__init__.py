"""HBP on CAN and CAN FD: ids, transport, self-contained stream frames, both ends. See SPEC.md, chapter 16.

Bytes of a CAN link are whole `CAN_RECORD`s. Like the rest of the protocol's core, this package does no I/O and
reads no clock.
"""
