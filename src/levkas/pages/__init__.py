"""HTML pages made from records, with one style of plots."""
