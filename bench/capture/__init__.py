"""Captures in the drive's own memory: what is asked for, armed, read and stored. Imports nothing by itself."""
