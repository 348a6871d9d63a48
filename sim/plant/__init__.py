"""The physical side of the bench: motor, inverter, shaft and sensors. It knows nothing of any firmware."""
