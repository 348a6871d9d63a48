"""`bench response`: the frequency response of a drive's current or speed loop, with margins and coherence."""
