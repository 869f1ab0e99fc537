"""A flight in the browser: one self-contained HTML file, in which the policy flies again."""
