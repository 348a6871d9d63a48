"""The simulated bench: plant, sensors, firmware, and the observers that firmware and host share."""
