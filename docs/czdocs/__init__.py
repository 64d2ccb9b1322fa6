"""What the site needs beyond Sphinx: formulas without scripts, tables from the code, an index of what there is."""
