"""campaign.toml as a schema: its tables, and what they say against one another."""
