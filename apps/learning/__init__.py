"""Learning from samples: collecting them, fitting models, judging what was fitted."""
