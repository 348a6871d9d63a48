"""The firmware's controllers as pure kernels: `Params`, `State` (NamedTuples of numbers), `init`, `step`.

    transforms     frames
    speed_loop     ramp and PI with anti-windup: speed reference to i_q reference
    current_loop   decoupled PI: current references to voltages in the rotor frame
    modulation     voltage limit, space-vector duties
    dead_time      what the inverter's dead time takes, added to the duties

Nothing here measures, estimates or integrates a plant. What is computed from the sample at k is in force from
k + 1 to k + 2: whoever calls turns a voltage into the stator frame at the angle of the middle of that time,
theta(k) + 1.5 * T_s * omega.
"""
