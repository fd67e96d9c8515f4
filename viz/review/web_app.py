"""The web application of a review: what is shown, what may be asked for, and who hears that the run has changed."""

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress

from starlette.applications import Starlette
from starlette.types import ASGIApp

from viz.review.asked import Asked
from viz.review.guard import Guard
from viz.review.jobs import Jobs
from viz.review.json_answers import fault
from viz.review.news import News
from viz.review.run_review import RunReview
from viz.review.shown import Shown

# Seconds between two looks at the run folder.
_LOOK = 0.5


def review_app(review: RunReview, token: str, nonce: str) -> ASGIApp:
    """The application, which answers below /TOKEN/ alone."""
    news = News()
    jobs = Jobs(news.tell, lambda: review.model)
    shown = Shown(review, jobs, news, nonce)
    routes = [*shown.routes, *Asked(review, jobs, news).routes]

    @asynccontextmanager
    async def lifespan(_: Starlette) -> AsyncIterator[None]:
        tasks = [asyncio.create_task(work) for work in (jobs.work(), _watch(review, news))]
        try:
            yield
        finally:
            for task in tasks:
                task.cancel()
            for task in tasks:
                with suppress(asyncio.CancelledError):
                    await task
            shown.viewer.close()

    return Guard(Starlette(routes=routes, lifespan=lifespan, exception_handlers={Exception: fault}), token, nonce)


async def _watch(review: RunReview, news: News) -> None:
    """Tell the pages when the run folder changes, whoever changed it."""
    before = review.version
    while True:
        await asyncio.sleep(_LOOK)
        if (now := review.version) != before:
            before = now
            news.tell({"type": "changed", "version": now})
