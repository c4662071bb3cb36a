"""What is done with captures: replay, re-execution, export, rewriting, reports."""
