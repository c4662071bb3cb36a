"""The recorder: everything that travels on the mesh, into MCAP files (see `cocoro.capture`)."""
