"""The recorder: writes everything that travels on the mesh into MCAP files (format and reading: `cocoro.capture`)."""
