"""FMUs: an exported block with the interface of FMI 2.0 or 3.0 for co-simulation, as C sources and as a library."""
