"""`bench commission`: what an unknown motor and its drive are, measured step by step, each value with its interval."""
