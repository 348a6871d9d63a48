"""What is made of data, without a link: captures, position errors, waveforms, wiring, verdicts."""
