"""Looking without computing: captures, parts, comparisons, doctor."""
