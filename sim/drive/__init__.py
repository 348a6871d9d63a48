"""The simulated drive: plant and firmware put together, and the links and servers that it is reached by."""
