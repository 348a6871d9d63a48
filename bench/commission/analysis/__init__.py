"""What a rotor that turned tells: pole pairs, flux, inertia, friction, Hall edges. Pure functions of windows."""
