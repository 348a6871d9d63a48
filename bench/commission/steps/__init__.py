"""The steps of a commissioning: what each commands, and what follows from what came."""
