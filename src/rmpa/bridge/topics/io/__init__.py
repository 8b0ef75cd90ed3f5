"""Carries out the plans of ``bridge.topics``: publications, subscriptions, routes and reports."""
