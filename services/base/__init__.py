"""The Create: its bytes (`oi`), the guard that owns its port, the driver that makes sense of it, the service."""
