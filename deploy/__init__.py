"""Profiles, and the supervisor that starts, watches and stops the processes of one."""
