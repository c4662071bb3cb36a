"""The recorder: writes everything that travels on the mesh into MCAP files (their format: `cocoro.capture`)."""
