"""Rotor position and speed estimators: the same kernels in the simulated drive, live on a host and offline.

Each module has one observer as pure kernels: `Params`, `State`, `Estimate` (NamedTuples of numbers), `init` and `step`
(one control period). `make_params` makes the `Params` of its `Settings`, a dataclass of the drive's parameters that it
takes, by their names. Nothing here knows a plant, a drive or a wire: times, codes, voltages and currents come in as
arguments, in SI units.

    hall_speed               Hall front end: sector, direction, average speed (1), overdue edges, sensors' faults
    sample                   what every position observer is given, made once by the front end
    average_speed            position by (1)-(2), [13], [14]
    sector_centre            the centre of the Hall sector, which is none of the paper's
    lookup_table             average speed with a table of the edges, [15]
    hall_vector              vector tracking of the Hall vector with the mechanical model, [16]
    hall_vector_decoupled    the same with its harmonics decoupled, [17]
    programmable_filter      rotor flux by cascaded programmable low-pass filters, [18]
    vector_tracking          position by (3)-(10)
    load_angle               the same with the load-angle compensation (18)-(19)
    vector_tracking_q15      (3)-(10) in 16-bit integers; `c/` has the same in C99
    edge_kalman              past the paper: a Kalman filter on Hall edges and back-EMF, of `covariance`,
                             `edge_lessons`, `edge_scales`, `hall_levels` and `hall_places`
    hall_edges               the places of the edges among the drive's parameters
    back_emf                 (5) and (6), for the observers
    by_front_end             the average-speed estimate, as an observer like the others
    entry                    what it takes to run one: a function over memory, compiled when it is first asked for
    catalogue                all of them by name, those of other packages too

Equation numbers: S.-Y. Kim, C. Choi, K. Lee, W. Lee, "An Improved Rotor Position Estimation With
Vector-Tracking Observer in PMSM Drives With Low-Resolution Hall-Effect Sensors", IEEE Trans. Ind. Electron.,
2011, DOI 10.1109/TIE.2010.2098367.
"""
