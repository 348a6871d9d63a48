"""Motion profiles: what is asked of drive and load machine over time, as a person writes it in TOML."""
