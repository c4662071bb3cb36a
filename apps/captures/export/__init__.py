"""Captures as films, tables, and files for Rerun and Foxglove."""
