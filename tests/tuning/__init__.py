"""What is left to gain: edge_kalman with other constants. `python -m tests.tuning`."""
