"""What nodes, bags, files and reports agree on: topics, parameters, units, defaults."""
