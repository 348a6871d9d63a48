"""Measurements, never collected as tests: `python -m tests.benchmarks` prints them beside their goals."""
