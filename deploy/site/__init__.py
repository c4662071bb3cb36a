"""A site: several machines with roles, certificates and access rules."""
