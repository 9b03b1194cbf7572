"""campaign.toml as a schema: tables, values, cross-checks and error messages."""
