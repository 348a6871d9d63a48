"""The acceptance tests that ship with the package: the paper's experiments, and what else a drive must do."""
