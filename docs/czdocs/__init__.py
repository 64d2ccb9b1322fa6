"""Extensions of Sphinx for the site: formulas without scripts, tables from the code, an index of names."""
