"""Pages that say what happened to an object, readable without levkas."""
