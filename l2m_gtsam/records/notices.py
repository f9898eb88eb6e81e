"""What a user should know that changes no result."""


class Notice(UserWarning):
    """One line, such as that of a file that was damaged and is made anew."""
