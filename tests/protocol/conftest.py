"""Property tests draw the same cases in every run, and no run fails for being slow."""

from hypothesis import settings

settings.register_profile("hallbench", derandomize=True, deadline=None, max_examples=40)
settings.load_profile("hallbench")
