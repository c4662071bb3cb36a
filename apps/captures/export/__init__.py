"""Captures in the forms that people look at: films, tables, Rerun and Foxglove."""
