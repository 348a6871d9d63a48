"""The configuration of the simulated bench: sections, ranges, and the TOML files that fill them."""
