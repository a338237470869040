/*
The sketch of a board, which connects it to its pins. Adapt the two functions and the constants to
your amplifier and your sensor; the protocol is in board.hpp.

In this example, a 12-bit analogue output of 0 to 3.3 V, centred at 1.65 V, drives an amplifier of
2 A/V, and a laser sensor outputs 0 to 3.3 V for 0 to 50 mm.
*/
#include "board.hpp"

const int32_t LIMIT = 3300000;     // uA
const int32_t RESOLUTION = 1612;   // uA: 3.3 V / 4095 * 2 A/V
const int64_t SAMPLE_PERIOD = 1000;  // us

hmsa::Board board(LIMIT, RESOLUTION);
int64_t next_sample = 0;

// micros() without its overflow after 71 min.
int64_t now() {
    static uint32_t before = 0;
    static int64_t time = 0;
    uint32_t present = micros();
    time += static_cast<uint32_t>(present - before);
    before = present;
    return time;
}

void put_out(int32_t microamperes) {
    analogWrite(A0, 2047 + microamperes / RESOLUTION);
}

int32_t measured() {  // in nm, i.e. 1e-6 mm
    return static_cast<int32_t>(analogRead(A1) * 12210LL);
}

void setup() {
    Serial.begin(1000000);
    analogWriteResolution(12);
    analogReadResolution(12);
    put_out(0);
}

void loop() {
    static int32_t level = 0;
    int32_t due = board.advance(now());
    if (due != level) {
        put_out(level = due);
    }
    if (now() >= next_sample) {
        next_sample = now() / SAMPLE_PERIOD * SAMPLE_PERIOD + SAMPLE_PERIOD;
        int64_t exposed = now();
        board.sample(exposed, measured());
    }
    if (Serial.available()) {
        board.receive(static_cast<char>(Serial.read()), now());
    }
    char byte;
    if (Serial.availableForWrite() && board.send(byte)) {
        Serial.write(byte);
    }
}
