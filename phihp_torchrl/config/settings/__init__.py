"""The YAML files, in a package of their own so that they are found in an installed wheel."""
