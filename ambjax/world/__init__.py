"""Everything outside the controller: plants, signals, sensors, amplifier and scenario."""
