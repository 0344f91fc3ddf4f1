// Browsers start no worker from a page that was opened from disk: there, the script of the search runs in a hidden frame.
if (location.protocol === "file:") {
  window.Worker = class {
    constructor(url) {
      this.frame = document.createElement("iframe")
      this.frame.hidden = true
      document.body.append(this.frame)
      const inside = this.frame.contentWindow
      inside.postMessage = (sent) => {
        const data = structuredClone(sent)
        setTimeout(() => this.onmessage?.({ data }))
      }
      const script = inside.document.createElement("script")
      script.src = new URL(url, location.href)
      this.ready = new Promise((resolve) => (script.onload = resolve))
      inside.document.body.append(script)
    }

    postMessage(sent) {
      const data = structuredClone(sent)
      const inside = this.frame.contentWindow
      const deliver = () => inside.dispatchEvent(new MessageEvent("message", { data }))
      this.ready.then(() => setTimeout(deliver))
    }

    terminate() {
      this.frame.remove()
    }
  }
}
