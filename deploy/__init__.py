"""Profiles, and the supervisor that starts and stops the processes of one."""
