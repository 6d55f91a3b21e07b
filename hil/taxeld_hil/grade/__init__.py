"""The grade of a session, by what the daemon publishes, and nothing of its inside."""
