"""`bench init`: finds a drive, asks about the bench, writes a bench.toml. Energises nothing."""
