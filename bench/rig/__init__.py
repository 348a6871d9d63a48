"""A bench at work: drive, load, consent, streams, recording, and an end with the outputs off that is seen to be one."""
