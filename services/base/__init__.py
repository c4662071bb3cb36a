"""The base: the Create's bytes (`oi`), the guard that owns its port, the driver (the pure core), and the service."""
