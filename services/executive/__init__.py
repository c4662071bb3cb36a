"""The executive: working memory, tasks, and the word on the emergency stop."""
