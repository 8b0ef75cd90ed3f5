"""What a user declares: resources, qualities, requirements, profiles, contexts, parameters."""
