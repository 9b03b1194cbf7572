// The audible form: tones, or a voice of this computer, for who looks at the painting and not at the screen.
import { gravest, type Frame } from "./session";

export type Sound = "silent" | "tones" | "voice";
const NEXT: Record<Sound, Sound> = { silent: "tones", tones: "voice", voice: "silent" };
const TONES = { green: [880], look: [440], stop: [330, 330, 330], waiting: [] };

export class Speaker {
  sound: Sound = "silent";
  private context: AudioContext | null = null;

  /** Go on to the next form; browsers let sound begin at a click alone. */
  next(): Sound {
    this.sound = NEXT[this.sound];
    this.context ??= new AudioContext();
    void this.context.resume();
    return this.sound;
  }

  /** Say what came: the gravest of the frames. */
  tell(frames: Frame[]): void {
    const frame = gravest(frames);
    if (!frame || this.sound === "silent") return;
    if (this.sound === "tones") this.play(TONES[frame.verdict]);
    else {
      const finding = frame.findings[0];
      const words = finding ? `${frame.verdict}. ${finding.text}. ${finding.advice}` : "good";
      speechSynthesis.cancel();
      speechSynthesis.speak(new SpeechSynthesisUtterance(words));
    }
  }

  private play(tones: number[]): void {
    const context = this.context;
    if (!context) return;
    tones.forEach((frequency, k) => {
      const [tone, volume] = [context.createOscillator(), context.createGain()];
      const start = context.currentTime + 0.35 * k;
      tone.frequency.value = frequency;
      volume.gain.setValueAtTime(0.2, start);
      volume.gain.exponentialRampToValueAtTime(0.001, start + 0.25);
      tone.connect(volume).connect(context.destination);
      tone.start(start);
      tone.stop(start + 0.3);
    });
  }
}
