"""The applications: they stand on services, simulator and deployment, and nothing stands on them."""
