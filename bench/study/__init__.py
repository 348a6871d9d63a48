"""Many simulated drives, each with figures of its own, through the same tests: what share of them passes, and why."""
