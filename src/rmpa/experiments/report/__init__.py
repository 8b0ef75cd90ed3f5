"""What was found, for people: figures, one page of HTML and one of Markdown, and two runs side by side."""
