"""Rotor position and speed estimators: the same kernels in the simulated drive, live on a host and offline.

Each module has one observer as pure kernels: `Params`, `State`, `Estimate` (NamedTuples of numbers), `init`,
`step` (one control period) and `run` (the loop over arrays). Nothing here knows a plant, a drive or a wire:
times, codes, voltages and currents come in as arguments, in SI units.

    hall_speed       Hall front end: sector, direction, average speed (1), overdue edges, faults of the
    sensors
    average_speed    position by (1)-(2)
    vector_tracking  position by (3)-(10), with the load-angle compensation (18)-(19)
    bank             the three fed from one stream of samples and edges, as drive and host run them

Equation numbers: S.-Y. Kim, C. Choi, K. Lee, W. Lee, "An Improved Rotor Position Estimation With
Vector-Tracking Observer in PMSM Drives With Low-Resolution Hall-Effect Sensors", IEEE Trans. Ind. Electron.,
2011, DOI 10.1109/TIE.2010.2098367.
"""
