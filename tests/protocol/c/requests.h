/* requests.h: requests as they should be, and with something wrong that a CRC hides. */
#ifndef REQUESTS_H
#define REQUESTS_H

#include "drive.h"

struct made {
    uint8_t type, flags, node;
    uint16_t tid, n;
    uint8_t payload[HBP_RX_MAX + 16];
};

static void put_f32(uint8_t *to, float value)
{
    memcpy(to, &value, sizeof value); /* the tests run on little-endian machines */
}

static float some_float(void)
{
    static const float often[] = {0.0f, 1.0f, 2.5f, 300.0f, 301.0f, 0.05f, 0.2f, 1.5f, -7.0f, 1e6f};
    uint32_t bits = draw();
    float value;
    if (below(4)) return often[below(sizeof often / sizeof often[0])];
    memcpy(&value, &bits, sizeof value);
    return value;
}

static uint32_t usually(uint32_t n, uint32_t mask) /* below n, at times anything */
{
    return below(8) ? below(n) : draw() & mask;
}

static void make_stream_set(struct made *m)
{
    unsigned ids = below(7), most = (HBP_RX_MAX - 8) / 2u;
    if (below(8) == 0 && n_channels > FEW) ids = below(n_channels < most ? n_channels + 1u : most);
    m->payload[0] = (uint8_t)below(5);
    m->payload[1] = (uint8_t)(below(8) < 5 ? 0 : below(4));
    put(m->payload + 2, usually(10, 0xFFFFu), 2);
    put(m->payload + 4, usually(30, 0xFFFFu), 2);
    if (m->payload[1] == HBP_STREAM_EDGES && below(8)) ids = 0;
    put(m->payload + 6, ids, 2);
    for (unsigned k = 0; k < ids; k++)
        put(m->payload + 8 + 2 * k, ids > 6 ? 1u + k : below(8) ? 1u + below(below(2) ? FEW : n_channels) : draw() & 7u, 2);
    m->n = (uint16_t)(8 + 2 * ids);
}

static void make_capture_arm(struct made *m)
{
    unsigned ids = 1u + below(5);
    uint8_t *p = m->payload;
    p[0] = (uint8_t)(below(3) ? usually(11, 0xFFu) : 0);
    put(p + 2, below(2) ? 1u : usually(9, 0xFFFFu), 2);
    put(p + 4, usually(40, 0xFFFFFFFFu), 4);
    put(p + 8, below(8) ? 1u + below(40) : draw(), 4);
    put_f32(p + 12, below(2) ? (float)below(2000) - 1000.0f : some_float());
    put(p + 16, below(8) ? 1u + below(FEW) : draw(), 2);
    put(p + 18, usually(9, 0xFFFFu), 2);
    put(p + 20, ids, 2);
    for (unsigned k = 0; k < ids; k++) put(p + 22 + 2 * k, below(8) ? 1u + (p[16] + k) % FEW : 1u + below(n_channels + 2u), 2);
    m->n = (uint16_t)(22 + 2 * ids);
}

/* Mostly what leads to a drive that runs and streams. */
static void make_request(struct made *m, uint8_t state, uint32_t faults)
{
    static const uint8_t types[] = {0x01, 0x02, 0x05, 0x05, 0x05, 0x05, 0x10, 0x10, 0x11, 0x12, 0x13, 0x14, 0x20, 0x20, 0x20, 0x21, 0x21,
                                    0x30, 0x30, 0x30, 0x31, 0x31, 0x31, 0x31, 0x32, 0x33, 0x38, 0x38, 0x39};
    uint8_t *p = m->payload;
    memset(m, 0, sizeof *m);
    m->type = types[below(sizeof types)];
    m->flags = 1;
    m->node = (uint8_t)(below(6) ? 1 : below(4));
    m->tid = (uint16_t)(1u + below(below(3) ? 0xFFFFu : 6u));
    switch (m->type) {
    case 0x01:
        put(p, below(4), 4);
        p[4] = (uint8_t)(below(8) ? 1 : below(3));
        p[5] = (uint8_t)(below(8) ? 1 : below(4));
        put(p + 6, below(4) ? 1024u : 100u + below(200), 2);
        m->n = 8;
        break;
    case 0x05:
        put(p, draw(), 4);
        m->n = 4;
        m->tid = 0;
        break;
    case 0x10:
        p[0] = (uint8_t)(below(8) ? below(2) : below(6));
        put(p + 2, below(2) ? below(300) : draw(), 2);
        put(p + 4, usually(300, 0xFFFFFFFFu), 4);
        m->n = 8;
        break;
    case 0x12: put_f32(p + 4, some_float()); /* fall through */
    case 0x11:
        put(p, below(8) ? 100u + below(6) : draw(), 2);
        m->n = m->type == 0x12 ? 8 : 4;
        break;
    case 0x20:
        p[0] = (uint8_t)usually(5, 0xFFu);
        if (below(8)) p[0] = (uint8_t)(state == HBP_STATE_IDLE ? 1 : state == HBP_STATE_FAULT ? 4 : 2);
        put(p + 4, !below(16) ? draw() : p[0] == 1 ? BOOT : p[0] == 4 ? faults : 0, 4);
        m->n = 8;
        break;
    case 0x21:
        p[0] = (uint8_t)(below(4) ? 1 : draw());
        put(p + 2, draw(), 2);
        put_f32(p + 4, some_float());
        put_f32(p + 8, below(4) ? 0.0f : some_float());
        m->n = 12;
        m->tid = 0;
        break;
    case 0x14:
        p[0] = (uint8_t)(below(8) ? 4 : draw());
        m->n = (uint16_t)(8 + below(30));
        put(p + 2, m->n - 8u, 2);
        put(p + 4, usually(600, 0xFFFFFFFFu), 4);
        for (unsigned k = 8; k < m->n; k++) p[k] = (uint8_t)draw();
        break;
    case 0x30: make_stream_set(m); break;
    case 0x38: make_capture_arm(m); break;
    case 0x31:
    case 0x32:
        put(p, below(8) ? (m->type == 0x32 ? 1u << below(4) : below(16)) : draw(), 4);
        m->n = 4;
        break;
    case 0x33:
        p[0] = (uint8_t)below(6);
        m->n = 4;
        break;
    default: break;
    }
    switch (below(24)) {
    case 0:
        if (m->n) m->n--;
        break;
    case 1: m->n++; break;
    case 2:
        m->n = (uint16_t)below(41);
        for (unsigned k = 0; k < m->n; k++) p[k] = (uint8_t)draw();
        break;
    case 3: m->type = (uint8_t)draw(); break;
    case 4: m->flags = (uint8_t)draw(); break;
    case 5: m->tid = (uint16_t)(below(2) ? 0 : draw()); break;
    case 6: p[below(m->n ? m->n : 1u)] = (uint8_t)draw(); break;
    case 7:
        m->n = (uint16_t)(HBP_RX_MAX - 4 + below(12));
        for (unsigned k = 0; k < m->n; k++) p[k] = (uint8_t)draw();
        break;
    default: break;
    }
}

#endif
