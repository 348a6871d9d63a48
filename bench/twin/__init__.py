"""A twin of a drive: the simulated drive's configuration that best reproduces recordings, and what it leaves."""
