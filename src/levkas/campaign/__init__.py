"""A campaign: campaign.toml and edits.toml, the files found for it, and guesses for a folder without one."""
