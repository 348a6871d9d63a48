"""`bench init`: finds a drive, asks what it cannot tell, writes a bench.toml. Energises nothing."""
