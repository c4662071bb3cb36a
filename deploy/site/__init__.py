"""A site: several machines and persons that share robots, with roles, certificates and access rules."""
