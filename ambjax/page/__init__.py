"""A page with sliders: one HTML file whose JavaScript is generated from the simulator's sampled loop."""
