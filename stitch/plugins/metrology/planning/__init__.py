"""Before measuring: what planned views would tell, and which further ones bring most."""
