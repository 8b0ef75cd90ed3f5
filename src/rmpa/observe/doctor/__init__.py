"""Everything that ``rmpa doctor`` looks at."""
