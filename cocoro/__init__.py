"""CoCoRo mesh: the API that every component is written against, and the operator's CLI."""
