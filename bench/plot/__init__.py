"""The standard figures of a recorded run, which is read once, piece by piece, however long it is.

    motion             pieces of a run without a gap, with the shaft's speed and phases
    spectrum           currents over frequency, with harmonics and distortion, where the speed stands still
    error_by_angle     position errors over the electrical angle
    error_by_speed     position errors over the speed
    current_plane      i_d and i_q as a plane, with their references and the limit
    hall_edges         where the Hall edges lie, and where they belong
    profile            what a motion profile asks for, before it is played
    looks              colours of estimates
    plot               all of them, to files

Each figure has something that `add`s pieces and knows numbers, and a function that draws these numbers. Angles and
their errors are electrical degrees where they are shown, rad before.
"""
