/* main.c: HBP in the PWM interrupt of an STM32G4, without any library of ST's.
 *
 * COMPILED, NEVER RUN. This is a pattern to copy from. No board has run it: check every register against RM0440, every pin against your
 * schematic, and try it with the power stage unsupplied first. It never drives current: control() asks for 0 V until you write yours.
 *
 *   arm-none-eabi-gcc -mcpu=cortex-m4 -mthumb -mfpu=fpv4-sp-d16 -mfloat-abi=hard -std=c99 -Os -c main.c ../../hbp.c
 *
 * With -DEXAMPLE_CAN and ../../hbp_can.c: classic CAN at 1 Mbit/s in place of the serial port. Start-up code and linker script are those of
 * your project; the handlers have the names of ST's start-up files.
 *
 * 170 MHz from the 16 MHz RC oscillator (on a CAN bus take a crystal).
 *   TIM1   PWM, 20 kHz, centre-aligned: PA8, PA9, PA10 high sides, PB13, PB14, PB15 low sides, break PB12 (low = fault)
 *   ADC1   injected, PA0 and PA1 (phase currents a and b), started by TIM1 where the low sides conduct; its end is "the PWM interrupt"
 *   TIM2   32 bits, runs freely: the tick of everything
 *   TIM4   Hall sensors a, b, c at PB6, PB7, PB8: begins anew at each edge, so that tick of an edge = TIM2 - TIM4
 *   USART2 PA2, PA3, 2 Mbit/s: circular DMA in, DMA out; or FDCAN1 at PA11 (in), PA12 (out)
 * Priorities: TIM4 before ADC1 before FDCAN1, so that edges come before the sample that covers them.
 *
 * THE OUTPUTS are on (MOE) only while hbp_may_run says so, which is looked at in every PWM period. The break input and a current beyond
 * its limit turn them off, and they stay off until the next START.
 */
#include "stm32g4.h"

#ifdef EXAMPLE_CAN
#include "../../hbp_can.h"
#else
#include "../../hbp.h"
#endif

#define CLOCK_HZ 170000000u
#define PWM_HZ 20000u
#define TOP (CLOCK_HZ / PWM_HZ / 2u)
#define MOE BIT(15)
#define BREAK_FLAG BIT(7)
#define AMPERES (50.0f / 4096) /* a count: 50 A over the range, zero at the middle; your amplifier's */
#define MIDDLE 2048
#define SPINS 1000000u         /* the longest wait for the hardware */

struct sample {
    int16_t i_a, i_b;
    uint8_t hall, status;
};

static float n_p = 4.0f, i_max = 5.0f, i_trip = 8.0f, omega_m_max = 300.0f, watchdog = 0.2f;
static volatile float wanted;    /* the last setpoint, mechanical rad/s */
static volatile uint8_t state, tripped;
static volatile uint64_t moment; /* tick of the last sample, the PWM interrupt's */
static uint8_t pins;             /* what the Hall inputs read after the last edge, TIM4's */
static float hall_offset, hall_swap, hall_invert;
static char serial[25];
static struct hbp drive;

static const struct hbp_channel channels[] = {
    {1, HBP_RAW_U8, HBP_UNIT_NONE, 0, offsetof(struct sample, hall), 1.0f, 0.0f, "hall"},
    {2, HBP_RAW_U8, HBP_UNIT_NONE, 0, offsetof(struct sample, status), 1.0f, 0.0f, "status"},
    {5, HBP_RAW_I16, HBP_UNIT_A, 0, offsetof(struct sample, i_a), AMPERES, 0.0f, "i_a"},
    {6, HBP_RAW_I16, HBP_UNIT_A, 0, offsetof(struct sample, i_b), AMPERES, 0.0f, "i_b"},
};
static const struct hbp_parameter parameters[] = {
    {100, HBP_UNIT_NONE, HBP_FLAG_READ_ONLY | HBP_FLAG_WHOLE, 1.0f, 32.0f, 4.0f, &n_p, "n_p"},
    {101, HBP_UNIT_A, 0, 0.5f, 10.0f, 5.0f, &i_max, "i_max"},
    {102, HBP_UNIT_A, 0, 0.5f, 20.0f, 8.0f, &i_trip, "i_trip"},
    {103, HBP_UNIT_RAD_PER_S, 0, 1.0f, 600.0f, 300.0f, &omega_m_max, "omega_m_max"},
    {104, HBP_UNIT_S, HBP_FLAG_IDLE_ONLY, 0.05f, 1.0f, 0.2f, &watchdog, "watchdog"},
    {105, HBP_UNIT_RAD, HBP_FLAG_IDLE_ONLY, -3.14159265f, 3.14159265f, 0.0f, &hall_offset, "hall_offset"}, /* your control adds it */
    {106, HBP_UNIT_NONE, HBP_FLAG_IDLE_ONLY | HBP_FLAG_WHOLE, 0.0f, 5.0f, 0.0f, &hall_swap, "hall_swap_hat"},
    {107, HBP_UNIT_NONE, HBP_FLAG_IDLE_ONLY | HBP_FLAG_WHOLE, 0.0f, 7.0f, 0.0f, &hall_invert, "hall_invert_hat"},
};

static uint8_t memory[48u << 10]; /* for captures */

static void outputs_off(void)
{
    TIM1->BDTR &= ~MOE;
}

/* ---- what hbp.c calls --------------------------------------------------------------------------------------------------- */

/* The PWM interrupt turns the outputs on, where `state` says so too, which is set last. */
static uint16_t enter(void *user, uint8_t next, float *detail)
{
    (void)user, (void)detail;
    if (next != HBP_STATE_RUNNING) outputs_off();
    wanted = 0.0f;
    TIM1->CCR1 = TIM1->CCR2 = TIM1->CCR3 = TOP / 2u; /* the same on all phases: no voltage */
    state = next;
    if (next == HBP_STATE_ARMED) tripped = 0;
    return 0;
}

static uint16_t setpoint(void *user, uint8_t mode, float value, float value2, float *detail)
{
    (void)user, (void)value2;
    *detail = (float)mode;
    if (mode != HBP_MODE_SPEED) return HBP_ERROR_NOT_SUPPORTED;
    *detail = omega_m_max;
    if (value > omega_m_max || value < -omega_m_max) return HBP_ERROR_OUT_OF_RANGE;
    wanted = value;
    return 0;
}

static uint8_t outputs_on(void *user) /* as the hardware has it */
{
    (void)user;
    return (TIM1->BDTR & MOE) != 0;
}

static uint32_t clear(void *user, uint32_t faults)
{
    (void)user, (void)faults;
    TIM1->SR = ~BREAK_FLAG; /* it stays while the input is low */
    return TIM1->SR & BREAK_FLAG ? HBP_FAULT_OVERCURRENT : 0u;
}

static const struct hbp_config config = {
    .node = 1, .role = HBP_ROLE_DRIVE, .features = HBP_FEATURE_EDGES, .tick_hz = CLOCK_HZ, .pwm_hz = PWM_HZ,
    .tick0 = TOP, /* TIM1 is at its top for the first time TOP ticks after both timers were started */
    .name = "stm32g4 example", .firmware = "1.0", .serial = serial,
    .sample_bytes = sizeof(struct sample), .channels = channels, .n_channels = sizeof channels / sizeof channels[0],
    .parameters = parameters, .n_parameters = sizeof parameters / sizeof parameters[0],
    .enter = enter, .setpoint = setpoint, .outputs_on = outputs_on, .clear = clear,
    .capture = memory, .capture_bytes = sizeof memory,
};

/* ---- interrupts --------------------------------------------------------------------------------------------------------- */

/* Your control: currents and Hall code in, duties out. This one asks for no voltage, whatever `wanted` is. */
static void control(const struct sample *sample)
{
    (void)sample;
    TIM1->CCR1 = TIM1->CCR2 = TIM1->CCR3 = TOP / 2u;
}

static int beyond(int16_t current)
{
    float amperes = (float)current * AMPERES;
    return amperes > i_trip || amperes < -i_trip;
}

static uint8_t hall_pins(void)
{
    return (uint8_t)(GPIOB->IDR >> 6 & 7u);
}

/* The Hall code where the inputs read `word`: wires and polarities put right (SPEC 12). */
static uint8_t hall_code(uint8_t word)
{
    static const uint8_t input_of[6][3] = {{0, 1, 2}, {1, 0, 2}, {0, 2, 1}, {2, 1, 0}, {1, 2, 0}, {2, 0, 1}};
    uint8_t code = 0, k;
    word = (uint8_t)(word ^ (int)hall_invert);
    for (k = 0; k < 3u; k++) code = (uint8_t)(code | (word >> input_of[(int)hall_swap][k] & 1u) << k);
    return code;
}

void TIM4_IRQHandler(void);
void TIM4_IRQHandler(void)
{
    uint32_t tick = TIM2->CNT - TIM4->CNT; /* this interrupt must not come later than TIM4 counts, 385 us */
    uint8_t before = pins;
    TIM4->SR = ~BIT(1);
    pins = hall_pins();
    if (pins != before) hbp_edge(&drive, tick, hall_code(before), hall_code(pins), 0); /* no encoder */
}

void ADC1_2_IRQHandler(void);
void ADC1_2_IRQHandler(void)
{
    static uint64_t tick = TOP;
    struct sample sample;
    ADC1->ISR = BIT(6);
    sample.i_a = (int16_t)((int)ADC1->JDR[0] - MIDDLE);
    sample.i_b = (int16_t)((int)ADC1->JDR[1] - MIDDLE);
    sample.hall = hall_code(pins);
    sample.status = state;
    if (beyond(sample.i_a) || beyond(sample.i_b) || (TIM1->SR & BREAK_FLAG)) {
        outputs_off();
        if (!tripped && state == HBP_STATE_RUNNING) hbp_raise(&drive, HBP_FAULT_OVERCURRENT);
        tripped = 1;
    }
    control(&sample);
    if (hbp_may_run(&drive, (uint32_t)tick) && state == HBP_STATE_RUNNING && !tripped) TIM1->BDTR |= MOE;
    else outputs_off();
    hbp_tick(&drive, &sample);
    moment = tick;
    tick += CLOCK_HZ / PWM_HZ;
}

static uint64_t now(void)
{
    uint64_t tick;
    __asm volatile("cpsid i" ::: "memory");
    tick = moment;
    __asm volatile("cpsie i" ::: "memory");
    return tick;
}

/* ---- the chip ----------------------------------------------------------------------------------------------------------- */

static int until(volatile uint32_t *where, uint32_t mask, uint32_t value)
{
    for (uint32_t k = 0; k < SPINS; k++)
        if ((*where & mask) == value) return 1;
    return 0;
}

static int start_clocks(void)
{
    SCB_CPACR |= 0xFu << 20; /* the FPU */
    RCC_APB1ENR1 |= BIT(28);  /* PWR */
    (void)RCC_APB1ENR1;
    PWR_CR5 &= ~BIT(8); /* range 1, boost: above 150 MHz */
    FLASH_ACR = BIT(10) | BIT(9) | BIT(8) | 4u;
    RCC_PLLCFGR = BIT(24) | 85u << 8 | 3u << 4 | 2u; /* 16 MHz / 4 * 85 / 2 */
    RCC_CR |= BIT(24);
    if (!until(&RCC_CR, BIT(25), BIT(25)) || !until(&FLASH_ACR, 15u, 4u)) return 0;
    RCC_CFGR = 8u << 4 | 3u; /* through half the clock for a microsecond */
    if (!until(&RCC_CFGR, 3u << 2, 3u << 2)) return 0;
    for (volatile uint32_t k = 0; k < 200; k++) {}
    RCC_CFGR = 3u;
    RCC_AHB1ENR |= BIT(0) | BIT(2);                        /* DMA1, DMAMUX */
    RCC_AHB2ENR |= BIT(0) | BIT(1) | BIT(13) | BIT(26);    /* GPIOA, GPIOB, ADC1, RNG */
    RCC_APB1ENR1 |= BIT(0) | BIT(2) | BIT(17) | BIT(25);   /* TIM2, TIM4, USART2, FDCAN */
    RCC_APB2ENR |= BIT(11);                                /* TIM1 */
    RCC_CRRCR |= BIT(0);                                   /* 48 MHz for the random numbers */
    RCC_CCIPR = (RCC_CCIPR & ~(3u << 24)) | 2u << 24;      /* FDCAN by the APB's clock */
    return until(&RCC_CRRCR, BIT(1), BIT(1));
}

static uint32_t random_number(void)
{
    RNG_CR = BIT(2);
    return until(&RNG_SR, BIT(0), BIT(0)) ? RNG_DR : UID(0);
}

static void pin(struct gpio *port, unsigned n, unsigned function)
{
    port->AFR[n / 8u] = (port->AFR[n / 8u] & ~(15u << n % 8u * 4u)) | function << n % 8u * 4u;
    port->MODER = (port->MODER & ~(3u << n * 2u)) | 2u << n * 2u;
}

static void pull_up(struct gpio *port, unsigned n)
{
    port->PUPDR = (port->PUPDR & ~(3u << n * 2u)) | 1u << n * 2u;
}

static void start_pins(void)
{
    for (unsigned n = 8; n <= 10; n++) pin(GPIOA, n, 6);
    for (unsigned n = 12; n <= 14; n++) pin(GPIOB, n, 6);
    pin(GPIOB, 15, 4);
    pull_up(GPIOB, 12);
    for (unsigned n = 6; n <= 8; n++) {
        pin(GPIOB, n, 2);
        pull_up(GPIOB, n); /* Hall outputs are open collectors, as a rule */
    }
    pin(GPIOA, 2, 7);
    pin(GPIOA, 3, 7);
#ifdef EXAMPLE_CAN
    pin(GPIOA, 11, 9);
    pin(GPIOA, 12, 9);
#endif
}

static int start_adc(void)
{
    ADC12_CCR = 3u << 16; /* the AHB's clock by 4 */
    ADC1->CR = 0; /* out of deep power-down */
    ADC1->CR = BIT(28);
    for (volatile uint32_t k = 0; k < 2000; k++) {} /* the regulator, 20 us */
    ADC1->CR = BIT(28) | BIT(31);
    if (!until(&ADC1->CR, BIT(31), 0)) return 0;
    for (volatile uint32_t k = 0; k < 100; k++) {}
    ADC1->ISR = BIT(0);
    ADC1->CR |= BIT(0);
    if (!until(&ADC1->ISR, BIT(0), BIT(0))) return 0;
    ADC1->CFGR = BIT(31);                                     /* no queue of injected sequences */
    ADC1->SMPR1 = 1u << 3 | 1u << 6;                          /* channels 1 and 2: 6.5 cycles */
    ADC1->JSQR = 2u << 15 | 1u << 9 | 1u << 7 | 8u << 2 | 1u; /* two, at each TRGO2 of TIM1 */
    ADC1->IER = BIT(6);                                       /* end of the sequence */
    ADC1->CR |= BIT(3);
    return 1;
}

static void start_timers(void)
{
    TIM1->CR1 = BIT(5);      /* centre-aligned */
    TIM1->CR2 = 7u << 20;    /* TRGO2: channel 4 */
    TIM1->ARR = TOP;
    TIM1->CCMR1 = 6u << 4 | BIT(3) | 6u << 12 | BIT(11);
    TIM1->CCMR2 = 6u << 4 | BIT(3) | 7u << 12; /* channel 4 rises where the count is at its top, once a period */
    TIM1->CCR4 = TOP - 1u;
    TIM1->CCR1 = TIM1->CCR2 = TIM1->CCR3 = TOP / 2u;
    TIM1->CCER = 0x555u;     /* three pairs */
    TIM1->BDTR = BIT(12) | BIT(11) | BIT(10) | 149u; /* break, low; off states driven; dead time 1 us; MOE off */
    TIM1->EGR = BIT(0);
    TIM1->SR = 0;
    TIM2->ARR = 0xFFFFFFFFu;
    TIM4->CR2 = BIT(7);      /* the three inputs, exclusive-or */
    TIM4->SMCR = 4u << 4 | 4u; /* begins anew at each edge of it */
    TIM4->CCMR1 = 3u << 4 | 3u; /* captured too, of a level that lasts 8 clocks */
    TIM4->ARR = 0xFFFFu;
    TIM4->CCER = BIT(0);
    TIM4->DIER = BIT(1);
    TIM4->CR1 = BIT(2) | BIT(0);
    pins = hall_pins();
    TIM2->EGR = BIT(0);
    TIM2->CR1 = BIT(0);
    TIM1->CR1 |= BIT(0);
}

static void interrupt(unsigned number, unsigned priority)
{
    NVIC_IPR(number) = (uint8_t)(priority << 4);
    NVIC_ISER(number / 32u) = BIT(number % 32u);
}

/* ---- the link ----------------------------------------------------------------------------------------------------------- */

#ifndef EXAMPLE_CAN

#define BAUD 2000000u

static struct hbp_link link;
static uint8_t received[256];

static void start_link(void)
{
    USART2->BRR = CLOCK_HZ / BAUD;
    USART2->CR3 = BIT(12) | BIT(7) | BIT(6); /* DMA both ways, no overrun: damage is seen by the CRC */
    USART2->CR1 = BIT(3) | BIT(2) | BIT(0);
    DMAMUX_CCR(1) = DMAMUX_USART2_RX;
    DMAMUX_CCR(2) = DMAMUX_USART2_TX;
    DMA1_CHANNEL(1)->CPAR = (uint32_t)(uintptr_t)&USART2->RDR;
    DMA1_CHANNEL(1)->CMAR = (uint32_t)(uintptr_t)received;
    DMA1_CHANNEL(1)->CNDTR = sizeof received;
    DMA1_CHANNEL(1)->CCR = BIT(7) | BIT(5) | BIT(0); /* circular */
    DMA1_CHANNEL(2)->CPAR = (uint32_t)(uintptr_t)&USART2->TDR;
    hbp_link_init(&link, BAUD / 10.0f);
}

static uint32_t join(uint32_t boot_id)
{
    return hbp_add(&link, &drive, &config, boot_id);
}

static void serve_link(void)
{
    static size_t read, sending;
    struct dma_channel *out = DMA1_CHANNEL(2);
    size_t written = (sizeof received - DMA1_CHANNEL(1)->CNDTR) % sizeof received;
    const uint8_t *bytes;
    if (written < read) {
        hbp_rx(&link, now(), received + read, sizeof received - read);
        read = 0;
    }
    if (written > read) hbp_rx(&link, now(), received + read, written - read);
    read = written;
    hbp_poll(&link, now());
    if (out->CNDTR) return;
    out->CCR = 0;
    hbp_tx_advance(&link, sending);
    sending = hbp_tx_peek(&link, &bytes);
    if (!sending) return;
    out->CMAR = (uint32_t)(uintptr_t)bytes;
    out->CNDTR = (uint32_t)sending;
    out->CCR = BIT(7) | BIT(4) | BIT(0);
}

#else

#define NODE 1u
#define ROOM 16u /* frames that have come, a power of two */

struct frame {
    uint32_t id, words[2];
    uint8_t length;
};

static struct hbp_can can;
static const struct hbp_can_bus bus = {.bitrate = 1000000};
static struct frame ring[ROOM];
static volatile uint32_t ring_head, ring_tail;

static void start_link(void)
{
    static const uint32_t wanted_ids[] = {0x000, NODE << 4, 0x100 | NODE << 4, 0x200, 0x200 | NODE << 4};
    FDCAN_CCCR |= BIT(0);
    if (!until(&FDCAN_CCCR, BIT(0), BIT(0))) return;
    FDCAN_CCCR |= BIT(1);
    FDCAN_NBTP = 33u << 25 | 134u << 8 | 33u; /* 170 quanta a bit, sampled at 80 % */
    for (unsigned n = 0; n < 5; n++) FDCAN_FILTER(n) = 2u << 30 | 1u << 27 | wanted_ids[n] << 16 | 0x7F0u;
    FDCAN_RXGFC = 5u << 16 | 2u << 4 | 2u << 2 | 3u; /* five filters; nothing else, nothing extended, no remote frames */
    FDCAN_TXBC = BIT(24);                            /* a queue, in which a frame can be taken back */
    FDCAN_IE = BIT(0);
    FDCAN_ILE = BIT(0);
    FDCAN_CCCR &= ~BIT(0);
    interrupt(FDCAN1_NUMBER, 2);
    (void)hbp_can_init(&can, &bus);
}

static uint32_t join(uint32_t boot_id)
{
    return hbp_can_add(&can, &drive, &config, boot_id);
}

void FDCAN1_IT0_IRQHandler(void);
void FDCAN1_IT0_IRQHandler(void)
{
    FDCAN_IR = BIT(0);
    while (FDCAN_RXF0S & 15u) {
        uint32_t at = FDCAN_RXF0S >> 8 & 3u, n;
        const volatile uint32_t *from = FDCAN_RX(at);
        struct frame *to = &ring[ring_head % ROOM];
        if (ring_head - ring_tail < ROOM) {
            n = from[1] >> 16 & 15u;
            to->id = from[0] >> 18 & 0x7FFu;
            to->length = (uint8_t)(n < 8u ? n : 8u);
            to->words[0] = from[2];
            to->words[1] = from[3];
            ring_head = ring_head + 1u;
        }
        FDCAN_RXF0A = at;
    }
}

/* Three buffers. Frames with the same identifier must go in order, so only one of them stands there at a time; a stream frame that has
 * waited for half a second is taken back. */
static void send_frames(void)
{
    static struct {
        uint32_t id, since;
        uint8_t streamed;
    } buffers[3];
    const struct hbp_can_frame *frame;
    uint32_t waiting = FDCAN_TXBRP, time = (uint32_t)now();
    for (unsigned n = 0; n < 3; n++) {
        if (!(waiting & BIT(n)) || !buffers[n].streamed || time - buffers[n].since < CLOCK_HZ / 2u) continue;
        FDCAN_TXBCR = BIT(n);
        buffers[n].streamed = 0; /* told once */
        hbp_can_gave_up(&can);
    }
    while ((frame = hbp_can_peek(&can)) != NULL) {
        uint32_t words[2] = {0, 0};
        unsigned place = 3;
        for (unsigned n = 0; n < 3; n++) {
            if (!(waiting & BIT(n))) place = n;
            else if (buffers[n].id == frame->id) return;
        }
        if (place == 3) return;
        for (unsigned k = 0; k < frame->length; k++) words[k / 4u] |= (uint32_t)frame->data[k] << k % 4u * 8u;
        buffers[place].id = frame->id;
        buffers[place].since = time;
        buffers[place].streamed = frame->streamed;
        FDCAN_TX(place)[0] = frame->id << 18;
        FDCAN_TX(place)[1] = (uint32_t)frame->length << 16;
        FDCAN_TX(place)[2] = words[0];
        FDCAN_TX(place)[3] = words[1];
        FDCAN_TXBAR = BIT(place);
        waiting |= BIT(place);
        hbp_can_advance(&can);
    }
}

static void serve_link(void)
{
    while (ring_tail != ring_head) {
        const struct frame *from = &ring[ring_tail % ROOM];
        uint8_t data[8];
        for (unsigned k = 0; k < 8; k++) data[k] = (uint8_t)(from->words[k / 4u] >> k % 4u * 8u);
        hbp_can_rx(&can, now(), from->id, data, from->length);
        ring_tail = ring_tail + 1u;
    }
    hbp_can_poll(&can, now());
    send_frames();
}

#endif

int main(void)
{
    if (!start_clocks()) return 1;
    start_pins();
    for (unsigned k = 0; k < 24; k++) serial[k] = "0123456789abcdef"[UID(k / 8u) >> (28u - k % 8u * 4u) & 15u];
    start_link();
    if (join(random_number()) || !start_adc()) return 1;
    interrupt(TIM4_NUMBER, 0);
    interrupt(ADC1_2_NUMBER, 1);
    start_timers();
    for (;;) serve_link();
}
