"""The host side: client, sinks and command line of the bench."""

from protocol import __version__

__all__ = ["__version__"]
