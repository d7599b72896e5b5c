"""What a person looks at: films and figures."""
