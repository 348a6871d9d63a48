"""Where the simulated bench can be reached: pty, TCP, CAN buses, or a link in virtual time."""
