"""Applications on capture files: reports, replay, re-execution, export, repair."""
