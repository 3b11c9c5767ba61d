"""The world that a cascade meets: plant, signals, sensors and scenario."""
