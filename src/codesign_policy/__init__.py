"""The task, its metrics, and the policies that act in it."""
