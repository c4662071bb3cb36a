"""A site: several machines and persons that share robots. Its folder, its certificates, and who has which."""
