// The server below this page's own address; nothing else is asked.

export async function read(path, options) {
  const answer = await fetch(path, options);
  const told = await answer.json().catch(() => ({ problem: `the server answers ${answer.status}` }));
  if (!answer.ok) throw new Error(told.problem || `the server answers ${answer.status}`);
  return told;
}

export const send = (path, body) =>
  read(path, { method: "POST", headers: { "content-type": "application/json" }, body: JSON.stringify(body) });

// Call `heard` with every event; after a break the browser asks again by itself.
export function listen(heard, lost) {
  const source = new EventSource("events");
  source.onmessage = event => heard(JSON.parse(event.data));
  source.onerror = () => lost();
}
