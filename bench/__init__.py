"""The host side: client, sinks and command line of the bench."""

from importlib.metadata import PackageNotFoundError, version

try:
    __version__ = version("hallbench")
except PackageNotFoundError:  # a source tree that was never installed
    __version__ = "0+unknown"
