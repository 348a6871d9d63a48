"""One link and what is on it: client, nodes, their safety, CAN bus, description, and the simulated drive as a child."""
