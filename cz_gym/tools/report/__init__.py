"""A benchmark's results for people: terminal, Markdown, figures, and one page that opens from disk."""
