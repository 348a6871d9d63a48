"""What lies between two cursors on a recorded run.

frequency   the fundamental of samples, and how sure it is
channel     what is measured of a quantity, an angle, a code, window by window
measure     all channels, and the samples, Hall edges and revolutions between
"""
