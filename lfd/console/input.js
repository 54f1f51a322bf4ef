// Keys, gamepad and the sign of life of a page of lfd's console. Messages: lfd/console/messages.py.
//
// A worker holds the connection: drawing the scene may keep the page busy for a while, the worker is never busy.
(() => {
  "use strict";
  const work = () => {
    const BEAT_MS = 20, BUSY_MS = 2000, AGAIN_MS = 300;
    let socket = null, url = "", hello = null, number = 0, alive = 0, drives = false;
    let keys = [], said = [], pad = null, late = [];
    const events = new Map(); // number of a message -> when its event was, for those that carry one
    const now = () => performance.timeOrigin + performance.now();
    const is_open = () => socket !== null && socket.readyState === WebSocket.OPEN;
    const send = (event_at) => {
      if (!is_open() || hello === null) return;
      number += 1;
      if (event_at !== undefined) events.set(number, event_at);
      socket.send(JSON.stringify({ n: number, keys, said, pad, late: late.slice(0, 50) }));
      said = []; late = [];
    };
    const connect = () => {
      socket = new WebSocket(url);
      socket.onopen = () => { if (hello) socket.send(JSON.stringify({ hello })); };
      socket.onmessage = (message) => {
        const told = JSON.parse(message.data);
        if (told.n !== undefined) {
          for (const [n, at] of events) if (n <= told.n) {
            events.delete(n);
            if (!told.paused) late.push(now() - at); // else the arm stood, and nobody waited for it
          }
        }
        if (told.tab !== undefined) hello.tab = told.tab;
        if (told.drives !== undefined) { drives = told.drives; events.clear(); }
        if (told.n === undefined) self.postMessage(told);
      };
      socket.onclose = () => { socket = null; self.postMessage({ drives: false }); setTimeout(connect, AGAIN_MS); };
    };
    self.onmessage = ({ data }) => {
      alive = performance.now();
      if (data.url) { url = data.url; connect(); }
      if (data.hello) {
        hello = { ...data.hello, tab: hello ? hello.tab : data.hello.tab };
        if (is_open()) socket.send(JSON.stringify({ hello }));
      }
      if (data.pad !== undefined) pad = data.pad;
      if (data.keys) {
        keys = data.keys; said = said.concat(data.said).slice(-20);
        send(drives ? data.at : undefined);
      }
    };
    setInterval(() => {
      if (performance.now() - alive > BUSY_MS) { keys = []; pad = null; } // a page that hangs holds nothing down
      send();
    }, BEAT_MS);
  };

  const worker = new Worker(URL.createObjectURL(new Blob([`(${work})()`], { type: "text/javascript" })));
  const scheme = location.protocol === "https:" ? "wss" : "ws";
  worker.postMessage({ url: `${scheme}://${location.host}/input` });

  let tab = sessionStorage.getItem("lfd-tab") || Math.random().toString(36).slice(2) + Date.now().toString(36);
  let seat = "", drives = false, known = new Set();
  const held = new Set();
  worker.onmessage = ({ data }) => {
    if (data.tab) { tab = data.tab; sessionStorage.setItem("lfd-tab", tab); }
    if (data.known) known = new Set(data.known);
    if (data.drives !== undefined) drives = data.drives;
    document.documentElement.dataset.lfdDrives = drives;
  };

  const press = (event, said) => worker.postMessage({
    keys: [...held].slice(0, 20), said, at: performance.timeOrigin + event.timeStamp,
  });
  const types = (target) => target instanceof HTMLElement &&
    (target.isContentEditable || ["INPUT", "TEXTAREA", "SELECT"].includes(target.tagName));
  const name = (event) => event.key.length === 1 ? event.key.toLowerCase() : event.key;
  const is_ours = (event) => drives && known.has(name(event)) &&
    !types(event.target) && !event.ctrlKey && !event.metaKey && !event.altKey;
  window.addEventListener("keydown", (event) => {
    if (!is_ours(event)) return;
    event.preventDefault(); event.stopImmediatePropagation(); // not for the scene's camera
    if (event.repeat) return;
    held.add(name(event)); press(event, [name(event)]);
  }, true);
  window.addEventListener("keyup", (event) => {
    if (!held.delete(name(event))) return;
    event.stopImmediatePropagation(); press(event, []);
  }, true);
  window.addEventListener("blur", (event) => { if (held.size) { held.clear(); press(event, []); } });

  setInterval(() => {
    const there = [...(navigator.getGamepads ? navigator.getGamepads() : [])].find((pad) => pad !== null);
    const pad = there ? {
      axes: there.axes.slice(0, 8), buttons: there.buttons.slice(0, 32).map((button) => button.value),
    } : null;
    const now = document.querySelector("[data-lfd-seat]");
    if (now !== null && now.dataset.lfdSeat !== seat) { // a connection of the scene, perhaps after another one
      seat = now.dataset.lfdSeat;
      worker.postMessage({ hello: { tab, seat } });
    }
    worker.postMessage({ pad });
  }, 30);
})();
