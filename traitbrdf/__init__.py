"""traitbrdf."""
