"""Files of other tools: what their readers say of a damaged one, in our words."""


def said(error: Exception) -> str:
    """What a reader of others says, in one line and not too long; its name where it says nothing."""
    text = " ".join("".join(c if c.isprintable() else " " for c in str(error)).split())
    return text[:200] if text else type(error).__name__
